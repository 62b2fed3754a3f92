"""Sphinx: `make docs` builds docs/ into build/docs."""

project = "univoxel"
extensions = ["myst_parser"]
html_theme = "furo"
html_title = "univoxel"
myst_heading_anchors = 3
# A folder whose pages are still to come
suppress_warnings = ["toc.empty_glob"]
exclude_patterns = []
