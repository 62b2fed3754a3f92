"""Lights: each says what falls on a surface point and what the point reflects."""

from univoxel.lights.base import AbstractLight
from univoxel.lights.sg import LocalSG, SGConfig

__all__ = ["AbstractLight", "LocalSG", "SGConfig"]
