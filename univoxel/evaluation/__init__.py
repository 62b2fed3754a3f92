"""A trained scene against the truth of its test views."""
