"""Training: the loop and its clock, the joint optimisation of light and materials, compression."""
