"""Scenes as photographs by Mitsuba 3, a path tracer of others, in the layout of our data sets.

`python -m lab.stress.render FOLDER VARIANT` is the process that renders: Mitsuba's
compiled variants end the process where the LLVM they find does not serve. Other kinds of scenes
have such a process of their own, and share `render_in` and `expose`.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lab.stress import scenes
from lab.stress.scenes import RELIGHT, Spec
from lab.stress.shapes import Part
from univoxel.camera import Cameras
from univoxel.core import guard
from univoxel.core.machine import threads_asked
from univoxel.data.images import write_exr
from univoxel.data.transforms import write_cameras
from univoxel.errors import MissingExtra, ProcessFailed, UserError

VARIANTS = ("llvm_ad_rgb", "scalar_rgb")  # the first is several times as fast and needs LLVM
SPEC = "scene.json"
VERSION = 1  # of what a spec means
DEPTH = 6  # most segments of a path
TEST_FACTOR = 2  # paths per pixel of test views against those of photographs
BATCH = 8_000_000  # paths at a time; bounds memory
FLASH_ASIDE = 0.1  # of a flash to the right of its lens, world units


@dataclass(frozen=True)
class Shot:
    """Pictures of some cameras in one light."""

    place: str  # folder of the data set that they go into
    cameras: Cameras  # V
    light: np.ndarray  # [H, 2H, 3] map, its first and last row on the poles
    samples: int  # paths per pixel
    # radians [V] that the light has turned by about +Z, counter-clockwise from above; None: none
    azimuths: np.ndarray | None = None
    flash: float = 0.0  # radiant intensity of a lamp beside the lens


def require() -> None:
    """Say before the work starts whether scenes can be rendered.

    Raises:
        MissingExtra: Mitsuba is missing.
    """
    if importlib.util.find_spec("mitsuba") is None:
        raise MissingExtra("the scenes need Mitsuba 3: pip install 'univoxel[stress]'")


def render(spec: Spec, folder: Path) -> Path:
    """Write the scene as a data set of linear OpenEXR pictures, unless it is there.

    Raises:
        UserError: the folder holds another scene.
        MissingExtra: Mitsuba is missing.
        ProcessFailed: Mitsuba failed.
        OSError: a file cannot be written.
    """
    return render_in(__name__, _identity(spec), folder)


def render_in(module: str, identity: str, folder: Path) -> Path:
    """Let a process of its own write a data set, unless it is there.

    Args:
        module: `python -m MODULE FOLDER VARIANT` writes it.
        identity: what folder/scene.json says, by which the scene is known.

    Raises:
        UserError, MissingExtra, ProcessFailed, OSError: as in `render`.
    """
    if holds(identity, folder):
        return folder
    require()
    begun = folder.with_name(f".{folder.name}.{os.getpid()}")
    said = ""
    try:
        for variant in VARIANTS:
            shutil.rmtree(begun, ignore_errors=True)
            begun.mkdir(parents=True)
            (begun / SPEC).write_text(identity, encoding="utf-8")
            command = guard.command(("-m", module, str(begun), variant))
            options: dict[str, Any] = {"env": guard.environment(), "check": False}
            done = subprocess.run(command, capture_output=True, text=True, **options)
            if done.returncode == 0:
                os.replace(begun, folder)
                return folder
            said = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
    finally:
        shutil.rmtree(begun, ignore_errors=True)
    raise ProcessFailed(f"{folder}: Mitsuba could not render it: {said}")


def rendered(spec: Spec, folder: Path) -> bool:
    """Whether the folder holds the scene.

    Raises:
        UserError: it holds another one.
    """
    return holds(_identity(spec), folder)


def holds(identity: str, folder: Path) -> bool:
    """Whether folder/scene.json says this.

    Raises:
        UserError: it says something else.
    """
    path = folder / SPEC
    if not path.exists():
        return False
    if path.read_text(encoding="utf-8") != identity:
        raise UserError(
            f"{path}: made for another scene: remove {folder}, or choose another folder for out",
            "out",
        )
    return True


def write_known(spec: Spec, folder: Path, parts: Sequence[Part]) -> None:
    """All of a data set that is known without rendering: cameras, maps, truth of the test views."""
    splits = {"train": scenes.train_cameras(spec), "test": scenes.test_cameras(spec)}
    names = {"train": spec.light, **{name: name for name in RELIGHT if spec.tests}}
    maps = {file: scenes.environment(spec, name) for file, name in names.items()}
    write_truth(folder, parts, splits, maps)


def write_truth(
    folder: Path, parts: Sequence[Part], splits: dict[str, Cameras], maps: dict[str, np.ndarray]
) -> None:
    """Cameras, maps, and the truth of the test views where there are any.

    Args:
        splits: cameras of train and test.
        maps: [H, 2H, 3] by name.
    """
    for split, cameras in splits.items():
        if len(cameras):
            (folder / split).mkdir(exist_ok=True)
            write_cameras(folder, split, cameras, [name_of(v) for v in range(len(cameras))])
    (folder / "envmaps").mkdir(exist_ok=True)
    for name, map in maps.items():
        write_picture(folder / "envmaps" / f"{name}.exr", map)
    if not (tests := len(splits["test"])):
        return
    np.savez(folder / "points.npz", points=scenes.surface_points(parts))
    (folder / "test" / "gt").mkdir(exist_ok=True)
    for view in range(tests):
        arrays = scenes.truth_of_view(parts, splits["test"], view)
        path = folder / "test" / "gt" / f"{name_of(view)}.npz"
        np.savez_compressed(path, **arrays)  # pyright: ignore[reportArgumentType]


def name_of(view: int) -> str:
    return f"r_{view:03d}"


def work(folder: Path, variant: str) -> None:
    """Write the data set of the spec in folder/scene.json."""
    spec = Spec(**json.loads((folder / SPEC).read_text(encoding="utf-8"))["spec"])
    parts = scenes.parts_of(spec)
    write_known(spec, folder, parts)

    def shot(place: str, cameras: Cameras, light: str, samples: int) -> Shot:
        azimuths = scenes.light_azimuths(spec, cameras) if light == spec.light else None
        map = scenes.environment(spec, light, True)
        return Shot(place, cameras, map, samples, azimuths)

    shots = [shot("train", scenes.train_cameras(spec), spec.light, spec.samples)]
    if spec.tests:
        cameras, samples = scenes.test_cameras(spec), TEST_FACTOR * spec.samples
        shots.append(shot("test", cameras, spec.light, samples))
        shots += [shot(f"relight/{light}", cameras, light, samples) for light in RELIGHT]
    expose(folder, variant, parts, shots)


def expose(folder: Path, variant: str, parts: Sequence[Part], shots: Sequence[Shot]) -> None:
    """Render pictures of an object into a data set, as linear OpenEXR premultiplied by alpha."""
    mi = started(variant)
    meshes = {f"part{i}": mesh_of(mi, f"part{i}", part) for i, part in enumerate(parts)}
    for shot in shots:
        (folder / shot.place).mkdir(parents=True, exist_ok=True)
        for view, picture in enumerate(_pictures(mi, meshes, shot)):
            write_picture(folder / shot.place / f"{name_of(view)}.exr", picture)


def started(variant: str) -> Any:
    """Mitsuba, on as many threads as are asked for."""
    import mitsuba as mi  # pyright: ignore[reportMissingImports]  the extra `stress`

    mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Error)
    if (threads := threads_asked()) is not None:
        import drjit  # pyright: ignore[reportMissingImports]  comes with Mitsuba

        drjit.set_thread_count(threads)
    return mi


def mesh_of(mi: Any, name: str, part: Part) -> Any:
    """A part as a mesh of Mitsuba's `principled` material; what varies over it is interpolated."""

    def value(name: str, values: float | np.ndarray) -> Any:
        varies = isinstance(values, np.ndarray)
        return {"type": "mesh_attribute", "name": f"vertex_{name}"} if varies else values

    props = mi.Properties()
    props["bsdf"] = mi.load_dict(
        {
            "type": "principled",
            "base_color": {"type": "mesh_attribute", "name": "vertex_color"},
            "roughness": value("roughness", part.roughness),
            "metallic": value("metallic", part.metallic),
            "specular": 0.5,  # F0 = 0.04
        }
    )
    mesh = mi.Mesh(name, len(part.vertices), len(part.faces), props=props, has_vertex_normals=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = part.vertices.ravel()
    params["vertex_normals"] = part.normals.ravel()
    params["faces"] = part.faces.astype(np.uint32).ravel()
    params.update()
    mesh.add_attribute("vertex_color", 3, part.base.ravel())
    for key in ("roughness", "metallic"):
        if isinstance(values := getattr(part, key), np.ndarray):
            mesh.add_attribute(f"vertex_{key}", 1, values)
    return mesh


def sensor_of(mi: Any, cameras: Cameras, view: int) -> dict[str, Any]:
    """A camera in Mitsuba's words, but for film and sampler."""
    fov = 2 * np.degrees(np.arctan(cameras.width / 2 / float(cameras.focal[view, 0])))
    matrix = np.eye(4)
    # Mitsuba's cameras look along +Z, with X to the left
    matrix[:3] = cameras.camera_to_world[view].double().numpy() * [-1, 1, -1, 1]
    to_world = mi.ScalarTransform4f(matrix.tolist())
    return {"type": "perspective", "fov": float(fov), "fov_axis": "x", "to_world": to_world}


def _pictures(mi: Any, meshes: dict[str, Any], shot: Shot) -> np.ndarray:
    """[V, H, W, 4] linear, premultiplied by alpha."""
    moves = shot.azimuths is not None or shot.flash
    azimuths = np.zeros(len(shot.cameras)) if shot.azimuths is None else shot.azimuths
    lamps: dict[str, Any] = {
        "light": {
            "type": "envmap",
            "bitmap": mi.Bitmap(shot.light),
            "to_world": mi.ScalarTransform4f(_upright(azimuths[0]).tolist()),
        }
    }
    if shot.flash:
        intensity = {"type": "rgb", "value": [shot.flash] * 3}
        lamps["flash"] = {"type": "point", "position": [0.0, 0.0, 0.0], "intensity": intensity}
    integrator = {"type": "path", "max_depth": DEPTH, "hide_emitters": True}
    scene = mi.load_dict({"type": "scene", "integrator": integrator, **lamps, **meshes})
    if not moves:
        return seen_by(mi, scene, shot.cameras, shot.samples)
    params, found = mi.traverse(scene), []
    for view, azimuth in enumerate(azimuths):  # a light for each
        if shot.azimuths is not None:
            params["light.to_world"] = mi.Transform4f(_upright(azimuth).tolist())
        if shot.flash:
            pose = shot.cameras.camera_to_world[view].double().numpy()
            params["flash.position"] = (pose[:, 3] + FLASH_ASIDE * pose[:, 0]).tolist()
        params.update()
        one = shot.cameras.of(torch.tensor([view]))
        found.append(seen_by(mi, scene, one, shot.samples)[0])
    return np.stack(found)


def _upright(azimuth: float) -> np.ndarray:
    """[4, 4] that brings a map upright, +Z up, see conventions, and turns it about +Z."""
    c, s = np.cos(azimuth), np.sin(azimuth)
    turn = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    return turn @ [[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]


def seen_by(mi: Any, scene: Any, cameras: Cameras, samples: int) -> np.ndarray:
    """[V, H, W, 4] of a scene of Mitsuba's, by all cameras at once."""
    film = {
        "type": "hdrfilm",
        "width": len(cameras) * cameras.width,
        "height": cameras.height,
        "pixel_format": "rgba",
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }
    each = max(1, min(samples, BATCH // (len(cameras) * cameras.width * cameras.height)))
    passes = -(-samples // each)
    # Stratified samples: 6 dB less noise than independent ones
    sampler = {"type": "multijitter", "sample_count": each}
    views = {f"view{v}": sensor_of(mi, cameras, v) for v in range(len(cameras))}
    sensor = mi.load_dict({"type": "batch", "film": film, "sampler": sampler, **views})
    total = sum(
        np.array(mi.render(scene, sensor=sensor, spp=each, seed=seed)) for seed in range(passes)
    )
    found = np.asarray(total) / passes
    return found.reshape(cameras.height, len(cameras), cameras.width, 4).swapaxes(0, 1)


def write_picture(path: Path, picture: np.ndarray) -> None:
    write_exr(path, dict(zip("RGBA", np.moveaxis(picture, -1, 0), strict=False)))


def _identity(spec: Spec) -> str:
    return json.dumps({"version": VERSION, "spec": dataclasses.asdict(spec)}, indent=1) + "\n"


if __name__ == "__main__":
    work(Path(sys.argv[1]), sys.argv[2])
