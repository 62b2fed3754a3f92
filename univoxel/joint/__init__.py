"""Light and materials on known geometry, by least squares: what the joint solve is made of."""
