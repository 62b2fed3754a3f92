"""The object told from what stands around it, in photographs without masks."""
