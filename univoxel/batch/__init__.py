"""Many scenes: jobs on one machine or on many, and what came out of them."""
