"""univoxel: from photographs to a relightable object, on a plain CPU."""

__version__ = "0.1.0"
