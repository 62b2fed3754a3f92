"""Many trainings side by side: each in a process of its own, and what comes out of them."""
