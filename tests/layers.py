"""The layers of the package as data: test_layers.py holds every import to them, and
docs/figures/diagrams.py draws them."""

# From the bottom up. A module imports only from layers below its own and, inside its folder, the
# helpers named here.
LAYERS = [
    {"errors"},
    {
        "bars",
        "child",
        "files",
        "installation",
        "machine",
        "names",
        "ranks",
        "records",
        "shelf",
        "threads",
        "validation",
    },
    {"cluster"},
    {"brdf", "camera", "color", "grid", "sphere"},
    {"ops"},
    {"envmap", "networks", "poses"},
    {"data", "fields", "lights", "optim"},
    {"scene"},
    {"checkpoint", "run"},
    {"losses"},
    {"assets", "metrics", "render"},
    {
        "joint.config",
        "preparation.config",
        "training.config",
        "compression.config",
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
    {"tasks.demo", "tasks.submit"},
    {"tasks.capture"},
    {"api"},
    {"experiments.plots", "experiments.record"},
    {"experiments.worker"},
    {"experiments.runner"},
    {"experiments"},
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
        *("matches", "observed_hull", "outlines", "registration", "surroundings"),
    },
    "training": {
        *(
            "clock",
            "pixels",
            "divergence",
            "exchange",
            "plateau",
            "progress",
            "step",
            "surface_update",
        ),
    },
    "joint": {"albedo_entropy", "equations", "initialise", "metals", "newton", "observations"},
    "compression": {"prune", "quality", "search", "sizes", "storage"},
    "confidence": {"survey"},
    "pictures": {"animation", "inline"},
    "evaluation": {"measures", "truth"},
    "segmentation": {"config", "distances", "gaps", "vote"},
    "page": {"maps", "transfer"},
    "cluster": {"piece", "shown", "work"},
    "batch": {"results", "scenes"},
    "report": {"drawing", "light", "photographs", "sides", "training"},
    "viewer": {"subject", "denoise", "frames", "film", "hosting", "incident", "studio"},
    "capture": {
        *("config", "photographs", "grouping", "turning", "database", "pairs", "engine", "model"),
        *("prepare", "video", "evidence"),
    },
    "experiments.stress": {"axes", "damage", "render", "report", "rough", "scenes", "shapes"},
}


def drawn_layers() -> list[set[str]]:
    """Layers of whole folders and files, from the bottom up; those of a folder's parts left out."""
    whole = ({name for name in names if "." not in name} for names in LAYERS)
    return [names for names in whole if names]
