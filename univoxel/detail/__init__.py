"""Texture at the photographs' own resolution: made after training, used by novel views, relighting
and exported meshes."""
