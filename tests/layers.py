"""The layers of the package, and of the laboratory, as data: test_layers.py holds every import to
them, and docs/figures/diagrams.py draws those of the package."""

# From the bottom up. A module imports only from layers below its own and, inside its folder, the
# helpers named here.
LAYERS = [
    {"errors", "retired"},
    {
        "bars",
        "child",
        "files",
        "installation",
        "machine",
        "names",
        "records",
        "shelf",
        "threads",
        "validation",
    },
    {"cluster"},
    {"brdf", "camera", "color", "grid", "sphere"},
    {"ops"},
    {"envmap", "networks", "orbit", "poses"},
    {"data", "fields", "lights", "optim"},
    {"scene"},
    {"checkpoint", "run", "verdict"},
    {"losses"},
    {"assets", "metrics", "render"},
    {
        "joint.config",
        "training.config",
        "confidence.config",
    },
    {"compression.choices"},
    {"config", "overrides"},
    {"presets"},
    {"preparation", "training"},
    {"joint"},
    {"confidence"},
    {"compression", "pictures"},
    {"build", "capture", "evaluation", "page", "segmentation"},
    {"batch", "report", "viewer"},
    {"tasks"},
    {"tasks.demo"},
    {"tasks.capture"},
    {"api"},
    {"parsing"},
    {"commands"},
    {"cli"},
]
HELPERS = {
    "ops": {
        "checks",
        "composite",
        "composite_field",
        "dense_grid",
        "density",
        "differentiable",
        "grid_sampling",
        "hash_grid",
        "native",
        "reflectance",
        "sparse_grid",
        "visibility",
    },
    "fields": {"bricks", "dense", "distances", "features"},
    "lights": {"base", "latlong", "lobes", "local", "priors", "quadrature"},
    "data": {
        *("arrays", "base", "foreign", "images", "inside", "kept", "lens", "maps", "masks"),
        *("missing", "orb", "radiance", "shots", "tensoir", "transforms"),
    },
    "render": {"density", "occlusion", "pipeline", "relight"},
    "assets": {"atlas", "base"},
    "preparation": {
        *("belief", "depth_sweep", "carving", "exposures", "hull", "light_frame", "masks"),
        *("matches", "mending", "observed_hull", "outlines", "pinned", "registration"),
        *("strays", "surroundings"),
    },
    "training": {
        *(
            "clock",
            "pixels",
            "divergence",
            "loop",
            "patches",
            "plateau",
            "progress",
            "surface_update",
        ),
    },
    "joint": {
        "albedo_entropy",
        "equations",
        "initialise",
        "metals",
        "mirrored_map",
        "mirrors",
        "newton",
        "observations",
        "sharp_sky",
    },
    "compression": {"search", "storage"},
    "confidence": {"survey"},
    "pictures": {"animation", "inline"},
    "evaluation": {"measures", "truth"},
    "segmentation": {"config", "gaps", "vote"},
    "page": {"maps", "transfer"},
    "cluster": {"piece", "shown", "work"},
    "batch": {"results", "scenes"},
    "report": {"drawing", "light", "photographs", "sides", "training"},
    "viewer": {"subject", "denoise", "frames", "film", "hosting", "incident", "studio"},
    "capture": {
        *("config", "photographs", "grouping", "turning", "database", "pairs", "engine", "model"),
        *("prepare", "video", "evidence"),
    },
    "commands": {"arguments"},
}

# Of lab/, which imports from the package what it likes, and which the package does not import
LAB_LAYERS = [
    {"plots", "record"},
    {"worker"},
    {"runner"},
    {"chart", "compare", "stress", "submit"},
    {"commands"},
]
LAB_HELPERS = {"stress": {"axes", "damage", "render", "report", "rough", "scenes", "shapes"}}


def drawn_layers() -> list[set[str]]:
    """Layers of whole folders and files, from the bottom up; those of a folder's parts left out."""
    whole = ({name for name in names if "." not in name} for names in LAYERS)
    return [names for names in whole if names]
