"""What the photographs fix of a scene's materials, and what they leave open."""
