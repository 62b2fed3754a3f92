"""Pictures of scenes: layers of a view, contact sheets, animations, timelapses."""
