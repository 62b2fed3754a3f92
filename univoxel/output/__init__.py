"""What a run becomes: meshes, pages, reports, moving pictures."""
