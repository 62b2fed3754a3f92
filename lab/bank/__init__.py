"""A bank of random scenes with known truth, half of them to tune with and half to judge with."""
