"""The layers of the package, and of the laboratory, as data: test_layers.py holds every import to
them, and docs/figures/diagrams.py draws those of the package."""

# From the bottom up. A folder or file imports only from layers below its own; inside a folder
# anything goes that is no circle.
LAYERS = [
    {"bars", "errors", "guard", "installation", "machine", "names", "records", "retired", "memmap"}
    | {"threads", "files", "overrides", "validation", "jobs", "steps", "parsing"},
    {"brdf", "camera", "color", "grid", "losses", "metrics", "orbit", "sphere"},
    {"ops"},
    {"envmap", "networks", "optim", "poses"},
    {"data", "fields", "lights"},
    {"checkpoint", "run", "scene", "verdict"},
    {"assets", "config", "presets", "render"},
    {"capture", "preparation", "training"},
    {"compression", "joint", "page", "segmentation"},
    {"build", "confidence"},
    {"pictures"},
    {"evaluation", "report", "viewer"},
    {"batch"},
    {"tasks"},
    {"api", "commands"},
    {"cli"},
]

# Of lab/, which imports from the package what it likes, and which the package does not import
LAB_LAYERS = [
    {"plots", "record"},
    {"worker"},
    {"runner"},
    {"chart", "compare", "stress", "submit"},
    {"commands"},
]
