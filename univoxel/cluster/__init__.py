"""Many pieces of work, each in processes of its own, on one machine or on many."""
