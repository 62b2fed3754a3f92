"""Sphinx: `make docs` builds docs/ into build/docs."""

project = "univoxel"
extensions = ["myst_parser"]
html_theme = "furo"
html_title = "univoxel"
myst_heading_anchors = 3
myst_enable_extensions = ["deflist"]
# Pages whose subjects are on their way into guide/ and explanation/
exclude_patterns = [
    f"{name}.md"
    for name in (
        *("architecture", "capacity", "data", "export", "fields", "lights", "relight", "trust"),
    )
]
