"""Photographs in, cameras out: reading of any format, structure from motion, what may be wrong."""
