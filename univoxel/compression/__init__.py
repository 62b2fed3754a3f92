"""What makes a scene as small as it may be: what is chosen, when, and what it costs."""
