"""univoxel: from photographs to a relightable object, on any CPU.

    run = univoxel.train("photos", "runs/mug", preset="fast")
    images = run.relight("studio.hdr", cameras="orbit 36")

`open_run` opens an existing run. The commands are available as functions:
`capture_object(photographs, out)` runs all steps from photographs to a mesh and a web page;
`find_poses(photographs, out)` finds cameras; `cutout(data, out)` makes masks; `evaluate(run)`
measures a run; `relight(run, envmap)` renders images; `export(run, mesh)` writes a mesh.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from univoxel.api import Run, TrainingProgress, open_run, train
    from univoxel.capture.cutout import cutout
    from univoxel.capture.poses import poses as find_poses
    from univoxel.cli.capture import capture as capture_object
    from univoxel.cli.evaluate import evaluate
    from univoxel.cli.export import export
    from univoxel.cli.relight import relight_images as relight
    from univoxel.errors import Cancelled, UserError

__version__ = "0.2.0"
__all__ = [
    "Cancelled",
    "Run",
    "TrainingProgress",
    "UserError",
    "capture_object",
    "cutout",
    "evaluate",
    "export",
    "find_poses",
    "open_run",
    "relight",
    "train",
]

# Imported on first use, so that `import univoxel` does not wait for torch
_PLACES = {
    "Cancelled": ("univoxel.errors", "Cancelled"),
    "Run": ("univoxel.api", "Run"),
    "TrainingProgress": ("univoxel.api", "TrainingProgress"),
    "UserError": ("univoxel.errors", "UserError"),
    "capture_object": ("univoxel.cli.capture", "capture"),
    "find_poses": ("univoxel.capture.poses", "poses"),
    "cutout": ("univoxel.capture.cutout", "cutout"),
    "evaluate": ("univoxel.cli.evaluate", "evaluate"),
    "export": ("univoxel.cli.export", "export"),
    "open_run": ("univoxel.api", "open_run"),
    "relight": ("univoxel.cli.relight", "relight_images"),
    "train": ("univoxel.api", "train"),
}


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _PLACES[name]
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted([*globals(), *_PLACES])
