"""The training loop: its clock, its optimiser, and what guards it."""
