"""Metrics of a trained scene against ground truth, and its uncertainty without ground truth."""
