"""Steps before the first gradient: masks, cameras, exposures and the carved visual hull."""
