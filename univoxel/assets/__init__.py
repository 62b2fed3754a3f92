"""Meshes with textures for other programs."""
