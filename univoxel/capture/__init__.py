"""Photographs in, cameras and masks out: reading of any format, structure from motion, masks,
what may be wrong."""
