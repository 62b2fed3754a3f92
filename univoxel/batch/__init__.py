"""Many scenes: the steps of each, what came out of them, and pages of it."""
