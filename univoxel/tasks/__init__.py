"""One module per command: a function that does the whole of it."""
