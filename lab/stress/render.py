"""Scenes as photographs by Mitsuba 3, a path tracer of others, in the layout of our data sets.

`python -m lab.stress.render FOLDER VARIANT` is the process that renders: Mitsuba's
compiled variants end the process where the LLVM they find does not serve.
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
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lab.stress import scenes
from lab.stress.scenes import RELIGHT, Spec
from lab.stress.shapes import Part
from univoxel.camera import Cameras
from univoxel.data.images import write_exr
from univoxel.data.transforms import write_cameras
from univoxel.errors import MissingExtra, ProcessFailed, UserError

VARIANTS = ("llvm_ad_rgb", "scalar_rgb")  # the first is several times as fast and needs LLVM
SPEC = "scene.json"
VERSION = 1  # of what a spec means
DEPTH = 6  # most segments of a path
TEST_FACTOR = 2  # paths per pixel of test views against those of photographs
BATCH = 8_000_000  # paths at a time; bounds memory


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
    if rendered(spec, folder):
        return folder
    require()
    begun = folder.with_name(f".{folder.name}.{os.getpid()}")
    said = ""
    try:
        for variant in VARIANTS:
            shutil.rmtree(begun, ignore_errors=True)
            begun.mkdir(parents=True)
            (begun / SPEC).write_text(_identity(spec), encoding="utf-8")
            command = [sys.executable, "-m", __name__, str(begun), variant]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
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
    path = folder / SPEC
    if not path.exists():
        return False
    if path.read_text(encoding="utf-8") != _identity(spec):
        raise UserError(
            f"{path}: is of another scene: remove {folder}, or choose another out", "out"
        )
    return True


def write_known(spec: Spec, folder: Path, parts: Sequence[Part]) -> None:
    """All of a data set that is known without rendering: cameras, maps, truth of the test views."""
    splits = {"train": scenes.train_cameras(spec), "test": scenes.test_cameras(spec)}
    for split, cameras in splits.items():
        if len(cameras):
            (folder / split).mkdir(exist_ok=True)
            write_cameras(folder, split, cameras, [name_of(v) for v in range(len(cameras))])
    (folder / "envmaps").mkdir(exist_ok=True)
    for name, file in ((spec.light, "train"), *((m, m) for m in RELIGHT if spec.tests)):
        _write_picture(folder / "envmaps" / f"{file}.exr", scenes.environment(spec, name))
    if not spec.tests:
        return
    np.savez(folder / "points.npz", points=scenes.surface_points(parts))
    (folder / "test" / "gt").mkdir(exist_ok=True)
    for view in range(spec.tests):
        arrays = scenes.truth_of_view(parts, splits["test"], view)
        path = folder / "test" / "gt" / f"{name_of(view)}.npz"
        np.savez_compressed(path, **arrays)  # pyright: ignore[reportArgumentType]


def name_of(view: int) -> str:
    return f"r_{view:03d}"


def work(folder: Path, variant: str) -> None:
    """Write the data set of the spec in folder/scene.json."""
    import mitsuba as mi  # pyright: ignore[reportMissingImports]  the extra `stress`

    mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Error)
    spec = Spec(**json.loads((folder / SPEC).read_text(encoding="utf-8"))["spec"])
    parts = scenes.parts_of(spec)
    write_known(spec, folder, parts)
    meshes = {f"part{i}": _mesh(mi, f"part{i}", part) for i, part in enumerate(parts)}

    def photograph(place: Path, cameras: Cameras, light: str, samples: int) -> None:
        place.mkdir(parents=True, exist_ok=True)
        map = scenes.environment(spec, light, True)
        azimuth = scenes.light_azimuths(spec, cameras) if light == spec.light else None
        if azimuth is None:
            found = _pictures(mi, meshes, map, cameras, samples)
        else:  # a light for each
            each = [(cameras.of(torch.tensor([v])), float(a)) for v, a in enumerate(azimuth)]
            found = [_pictures(mi, meshes, map, one, samples, a)[0] for one, a in each]
        for view, picture in enumerate(found):
            _write_picture(place / f"{name_of(view)}.exr", picture)

    photograph(folder / "train", scenes.train_cameras(spec), spec.light, spec.samples)
    if spec.tests:
        cameras = scenes.test_cameras(spec)
        photograph(folder / "test", cameras, spec.light, TEST_FACTOR * spec.samples)
        for light in RELIGHT:
            photograph(folder / "relight" / light, cameras, light, TEST_FACTOR * spec.samples)


def _mesh(mi: Any, name: str, part: Part) -> Any:
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(
        {
            "type": "principled",
            "base_color": {"type": "mesh_attribute", "name": "vertex_color"},
            "roughness": part.roughness,
            "metallic": part.metallic,
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
    return mesh


def _pictures(
    mi: Any,
    meshes: dict[str, Any],
    light: np.ndarray,
    cameras: Cameras,
    samples: int,
    azimuth: float = 0.0,
) -> np.ndarray:
    """[V, H, W, 4] linear, premultiplied by alpha.

    Args:
        azimuth: radians that the light is turned by about +Z, counter-clockwise from above.
    """
    upright = [[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]  # +Z up, see conventions
    c, s = np.cos(azimuth), np.sin(azimuth)
    turn = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    to_world = (turn @ upright).tolist()
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
    sensors: dict[str, Any] = {"type": "batch", "film": film, "sampler": sampler}
    fov = 2 * np.degrees(np.arctan(cameras.width / 2 / float(cameras.focal[0, 0])))
    for view, pose in enumerate(cameras.camera_to_world.double().numpy()):
        matrix = np.eye(4)
        matrix[:3] = pose * [-1, 1, -1, 1]  # Mitsuba's cameras look along +Z, with X to the left
        sensors[f"view{view}"] = {
            "type": "perspective",
            "fov": float(fov),
            "to_world": mi.ScalarTransform4f(matrix.tolist()),
        }
    scene = mi.load_dict(
        {
            "type": "scene",
            "light": {
                "type": "envmap",
                "bitmap": mi.Bitmap(light),
                "to_world": mi.ScalarTransform4f(to_world),
            },
            "sensor": sensors,
            "integrator": {"type": "path", "max_depth": DEPTH, "hide_emitters": True},
            **meshes,
        }
    )
    total = sum(np.array(mi.render(scene, spp=each, seed=seed)) for seed in range(passes))
    found = np.asarray(total) / passes
    return found.reshape(cameras.height, len(cameras), cameras.width, 4).swapaxes(0, 1)


def _write_picture(path: Path, picture: np.ndarray) -> None:
    write_exr(path, dict(zip("RGBA", np.moveaxis(picture, -1, 0), strict=False)))


def _identity(spec: Spec) -> str:
    return json.dumps({"version": VERSION, "spec": dataclasses.asdict(spec)}, indent=1) + "\n"


if __name__ == "__main__":
    work(Path(sys.argv[1]), sys.argv[2])
