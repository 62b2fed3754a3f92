"""Training: the loop and its clock, the joint solve of light and materials, compression."""
