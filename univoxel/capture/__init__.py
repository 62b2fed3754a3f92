"""From photographs to cameras and masks: image reading, structure from motion, masks, checks."""
