"""What a point of space is: distances, features, and the heads that decode them."""
