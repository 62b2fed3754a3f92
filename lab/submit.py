"""What Stanford-ORB's benchmark measures of a trained scene, and the list that it reads.

DIR/submission.json                 info.<scene>: view, light, geometry, material: output_* and
                                    target_* files; shape: output_mesh, target_mesh
DIR/view/<name>.exr                 test views, linear
DIR/light/<scene>_<name>.exr        test views of other scenes, in their light
DIR/normal/<name>.exr               axes of the camera: x right, y up, z backwards
DIR/depth/<name>.exr                along -Z
DIR/albedo/<name>.exr               linear
DIR/mesh.obj

Read beside what univoxel.data.truth reads, for the light of other scenes:

ground_truth/<scene>/env_map/<name>.exr    the light in which <name> was photographed, around its
                                           camera: -Z in the middle, X to the right, Y on top

Source: the public code of Kuang et al. 2023 (Stanford-ORB), scripts/test.py, orb/pipelines and
orb/utils/env_map.py.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from univoxel.camera import Cameras, resize
from univoxel.cli.export import export
from univoxel.core.choices import BOUNCES, SAMPLES
from univoxel.core.files import write_json
from univoxel.core.progress_bar import track
from univoxel.core.records import AlbedoNear, Mesh
from univoxel.data import Photos
from univoxel.data.images import write_exr
from univoxel.data.load_images import cameras_of
from univoxel.data.transforms import read_frames
from univoxel.detail.texture import albedo_near
from univoxel.envmap import EnvMap, lookup, read_map, tables
from univoxel.errors import DataError, ExistingFile, UserError
from univoxel.evaluation.measures import Relighting, render_layers
from univoxel.render.pipeline import extract_mesh
from univoxel.render.relight import Lighting, traced_mesh
from univoxel.run import photos_of
from univoxel.scene import Scene, load_scene
from univoxel.sphere import latlong_directions

SIZE = 512  # pixels along a side of the benchmark's pictures
FILE = "submission.json"
LIGHT = "light"  # name of the only one of a picture
# From the axes of a camera to those of maps, where the middle is +X and the top +Z
TO_MAP = torch.tensor([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@torch.no_grad()
def submit(
    run: str | Path, out: str | Path, samples: int = SAMPLES, bounces: int = BOUNCES
) -> Path:
    """Write the images that Stanford-ORB evaluates of a run; return the file that lists them.

    Views of other scenes are rendered under the light measured there, if the data contains it.

    Args:
        run: folder of a run that was trained on a scene of Stanford-ORB.
        out: folder to write to.
        samples: light samples per pixel of relit pictures, at least 1.
        bounces: reflections between parts of the object in relit pictures, 0 for none.

    Raises:
        DataError: the run or its data cannot be used, or the scene is not from Stanford-ORB.
        ExistingFile: out exists already.
        UserError: samples or bounces out of range, or there is no surface.
        OSError: a file cannot be written.
    """
    if samples < 1 or bounces < 0:
        raise UserError(
            f"submit: expected samples >= 1 and bounces >= 0, got {samples=} and {bounces=}",
            "samples",
            "bounces",
        )
    run, out = Path(run), Path(out)
    if out.exists():
        raise ExistingFile(f"{out} exists already: choose another folder for out", "out")
    photos = photos_of(run)
    folder, truth = scene_folders(photos.folder)
    scene, near = load_scene(run), albedo_near(run)
    info: dict[str, object] = _test_views(scene, photos, folder, truth, out, near)
    mesh = extract_mesh(scene)
    info["light"] = _relit_views(scene, mesh, photos, truth, out, samples, bounces, near)
    export(run, out / "mesh.obj")
    target = truth / "mesh_blender" / "mesh.obj"
    info["shape"] = {"output_mesh": _text(out / "mesh.obj"), "target_mesh": _text(target)}
    write_json(out / FILE, {"info": {folder.name: info}})
    return out / FILE


def scene_folders(folder: Path) -> tuple[Path, Path]:
    """The folder of a scene's linear photographs, and that of its truth.

    Raises:
        DataError: the folder is no scene of Stanford-ORB.
    """
    folder = folder.resolve()
    root = folder.parent.parent
    truth = root / "ground_truth" / folder.name
    if not truth.is_dir():
        raise DataError(f"{folder}: expected a scene of Stanford-ORB with {truth}, found none")
    return root / "blender_HDR" / folder.name, truth


def orb_light(path: Path, camera: Cameras) -> EnvMap:
    """The light around a camera, in the world.

    Raises:
        DataError: the file cannot be used.
    """
    local = read_map(path)
    to_camera = camera.camera_to_world[0, :, :3].T
    direction = latlong_directions(len(local.radiance)) @ (TO_MAP @ to_camera).T
    return EnvMap(lookup(local, direction).clamp_min(0))


def _test_views(
    scene: Scene, photos: Photos, folder: Path, truth: Path, out: Path, near: AlbedoNear | None
) -> dict[str, object]:
    """Render the test views; the lists view, geometry and material."""
    view, geometry, material = [], [], []
    cameras = resize(photos.cameras, SIZE)
    for v in track(range(len(photos)), "rendering test views"):
        name = photos.names[v]
        layers = render_layers(scene, cameras, v, albedo_near=near)
        normal = layers.normal @ cameras.camera_to_world[v, :, :3]
        files = {
            "view": _write(out / "view" / f"{name}.exr", layers.rgb),
            "normal": _write(out / "normal" / f"{name}.exr", normal),
            "depth": _write(out / "depth" / f"{name}.exr", layers.depth),
            "albedo": _write(out / "albedo" / f"{name}.exr", layers.albedo),
        }
        mask = {"target_mask": _text(folder / "test_mask" / f"{name}.png")}
        photo = _text(folder / "test" / f"{name}.exr")
        view.append({"output_image": files["view"], "target_image": photo})
        albedo = _text(truth / "pseudo_gt_albedo" / f"{name}.png")
        material.append({"output_image": files["albedo"], "target_image": albedo, **mask})
        geometry.append(
            {
                "output_depth": files["depth"],
                "target_depth": _text(truth / "z_depth" / f"{name}.npy"),
                "output_normal": files["normal"],
                "target_normal": _text(truth / "surface_normal" / f"{name}.npy"),
                **mask,
            }
        )
    return {"view": view, "geometry": geometry, "material": material}


def _relit_views(
    scene: Scene,
    mesh: Mesh,
    photos: Photos,
    truth: Path,
    out: Path,
    samples: int,
    bounces: int,
    near: AlbedoNear | None,
) -> list[dict[str, str]]:
    """Render views of other scenes, each in its own light; the list light."""
    path = photos.folder / "transforms_novel.json"
    if not path.is_file():
        return []
    _, shots, _ = read_frames(path)
    traced, found = traced_mesh(mesh, scene.field.voxel_size), []
    for shot in track(shots, "relighting"):
        there, name = shot.image.parent.parent.name, shot.image.stem
        camera = resize(cameras_of([shot.pose], [shot.lens]), SIZE)
        light = orb_light(truth.parent / there / "env_map" / f"{name}.exr", camera)
        relighting = Relighting(
            {LIGHT: Lighting(tables(light))}, traced, torch.ones(3), samples, bounces
        )
        rgb = render_layers(scene, camera, 0, relighting, albedo_near=near).relit[LIGHT]
        file = _write(out / "light" / f"{there}_{name}.exr", rgb)
        found.append({"output_image": file, "target_image": _text(shot.image)})
    return found


def _write(path: Path, picture: Tensor) -> str:
    """Write a picture [S, S, 3] or [S, S] as the benchmark reads it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    channels = (
        {"Z": picture} if picture.dim() == 2 else dict(zip("RGB", picture.unbind(2), strict=True))
    )
    write_exr(path, channels, half=False)
    return _text(path)


def _text(path: Path) -> str:
    return str(path.resolve())
