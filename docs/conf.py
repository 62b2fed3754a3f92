"""Sphinx: `make docs` builds docs/ into build/docs."""

project = "univoxel"
extensions = ["myst_parser"]
myst_heading_anchors = 3
smartquotes = False  # two dashes are an option, not a dash
html_theme = "furo"
html_title = "univoxel"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_copyright = False
