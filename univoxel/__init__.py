"""univoxel: from photographs to a relightable object, on a plain CPU.

The tasks of the command line are functions here: `univoxel.cutout(data, out)` for photographs
without masks, `univoxel.train(config)`, `univoxel.evaluate(run)`,
`univoxel.relight(run, envmap)`, which returns pictures, and `univoxel.export(run, mesh)`.
"""

from importlib import import_module

__version__ = "0.1.0"

# Imported when asked for: `import univoxel` does not wait for torch.
_TASKS = {
    "find_poses": ("univoxel.tasks.poses", "poses"),
    "cutout": ("univoxel.tasks.cutout", "cutout"),
    "train": ("univoxel.tasks.train", "train"),
    "evaluate": ("univoxel.tasks.evaluate", "evaluate"),
    "relight": ("univoxel.tasks.relight", "relight_images"),
    "export": ("univoxel.tasks.export", "export"),
}


def __getattr__(name: str):
    if name not in _TASKS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, function = _TASKS[name]
    return getattr(import_module(module), function)


def __dir__() -> list[str]:
    return sorted([*globals(), *_TASKS])
