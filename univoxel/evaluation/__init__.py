"""Metrics of a trained scene against ground truth, and its expected errors without ground truth."""
