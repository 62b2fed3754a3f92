"""Properties of points in space: distances, features, and the networks that decode them."""
