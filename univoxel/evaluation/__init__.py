"""A trained scene against the truth of its test views, and how sure it is without."""
