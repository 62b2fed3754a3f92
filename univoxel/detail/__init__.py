"""Textures at the photographs' resolution, made after training for novel views, relighting and
export."""
