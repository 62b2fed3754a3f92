"""A trained scene under new environment maps, from the test views, an orbit or given cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from json import JSONDecodeError, loads
from pathlib import Path

import torch
from rich.progress import track
from torch import Tensor

from univoxel.camera import Cameras
from univoxel.color import linear_to_srgb
from univoxel.data import DataError, load_cameras, load_photos
from univoxel.data.images import read_image, write_exr, write_png
from univoxel.envmap import EnvMap
from univoxel.records import Mesh
from univoxel.render.pipeline import extract_mesh, surface_of_view
from univoxel.render.relight import relight_surface
from univoxel.scene import Scene, load_scene

ORBIT_FRAMES = 60
ELEVATION = 25.0  # degrees, of an orbit's cameras above the object's middle
VIEW_ANGLE = 40.0  # degrees, of an orbit's cameras
ORBIT_SIZE = 512  # pixels along an orbit's pictures
MARGIN = 1.05  # room that an orbit leaves around the object


@torch.no_grad()
def relight(
    run: Path,
    envmap: Path | Sequence[Path],
    out: Path,
    *,
    cameras: str = "test",
    resolution: int | None = None,
    rotate: float = 0.0,
    exposure: float = 1.0,
    samples: int = 64,
    bounces: int = 2,
    resume: bool = False,
    progress: bool = True,
) -> None:
    """Render a trained scene under environment maps, a PNG and an EXR file per frame.

    The PNG is sRGB, clipped at 1, with straight alpha. The EXR holds half floats: rgb.* and
    albedo.* linear, composited on black; normal.* (world) and depth along -Z, 0 where nothing is;
    alpha. Files appear whole or not at all.

    Args:
        run: folder of the trained scene.
        envmap: an equirectangular map, or several: each then gets a folder of its name in `out`.
        out: folder for the pictures.
        cameras: "test" for the test views of the data trained on, "orbit" or "orbit N" for N frames
            around the object, else a file in the form of transforms_test.json.
        resolution: pixels along the width; as in the data when left out (an orbit: 512).
        rotate: turns the maps counter-clockwise about +Z, degrees.
        exposure: factor on the light.
        samples: light samples per pixel; noise falls with the root of it.
        bounces: reflections between parts of the object, 0 for direct light only.
        resume: keep frames whose two files are there already.
        progress: show a bar.

    Raises:
        DataError, ValueError: the run, a map or the cameras cannot be used, or a number is out of
            range.
        OSError: a file cannot be read or written.
    """
    for name, value in (("samples", samples), ("resolution", resolution)):
        if value is not None and value < 1:
            raise ValueError(f"relight: {name} must be at least 1, got {value}")
    if bounces < 0:
        raise ValueError(f"relight: bounces must be at least 0, got {bounces}")
    several = not isinstance(envmap, (str, Path))
    paths = [Path(path) for path in envmap] if several else [Path(envmap)]
    if len({path.stem for path in paths}) != len(paths) or not paths:
        raise ValueError(
            "relight: expected environment maps of different names, got "
            f"{[str(path) for path in paths]}"
        )
    maps = {path.stem: _read_map(path, rotate, exposure) for path in paths}
    scene = load_scene(run)
    mesh = extract_mesh(scene)
    names, views = _cameras(run, cameras, resolution, mesh)
    frames = [(view, name) for view in range(len(views)) for name in maps]
    for view, name in track(frames, description="relighting", disable=not progress):
        stem = (out / name if several else out) / names[view]
        png, exr = stem.with_name(f"{stem.name}.png"), stem.with_name(f"{stem.name}.exr")
        if resume and png.is_file() and exr.is_file():
            continue
        stem.parent.mkdir(parents=True, exist_ok=True)
        layers = _render(scene, mesh, views, view, maps[name], samples, bounces)
        write_exr(exr, layers)
        write_png(png, _picture(layers))


def orbit(mesh: Mesh, frames: int, size: int) -> Cameras:
    """Cameras on a circle around a mesh that see all of it, starting at +X, counter-clockwise."""
    low, high = mesh.vertices.amin(0), mesh.vertices.amax(0)
    middle = (low + high) / 2
    radius = MARGIN * (mesh.vertices - middle).norm(dim=1).max()
    half = math.radians(VIEW_ANGLE / 2)
    phi = 2 * math.pi * torch.arange(frames) / frames
    up = torch.full_like(phi, math.radians(ELEVATION))
    back = torch.stack([up.cos() * phi.cos(), up.cos() * phi.sin(), up.sin()], -1)
    right = torch.stack([-phi.sin(), phi.cos(), torch.zeros_like(phi)], -1)
    position = middle + back * radius / math.sin(half)
    pose = torch.stack([right, torch.linalg.cross(back, right), back, position], -1)
    focal = torch.full((frames, 2), size / 2 / math.tan(half))
    return Cameras(pose, focal, torch.full((frames, 2), size / 2), size, size)


def _render(
    scene: Scene, mesh: Mesh, views: Cameras, view: int, envmap: EnvMap, samples: int, bounces: int
) -> dict[str, Tensor]:
    """The channels of one frame, [H, W] each."""
    surface, wo = surface_of_view(scene, views, view)
    rgb = relight_surface(
        surface,
        wo,
        mesh,
        envmap,
        samples=samples,
        bounces=bounces,
        offset=scene.field.voxel_size,
        seed=view,
    )
    alpha = surface.opacity[:, None]
    there = (alpha > 0).float()
    backward = views.camera_to_world[view, :, 2]
    values = {
        "rgb.RGB": rgb * alpha,
        "albedo.RGB": surface.albedo * alpha,
        "normal.XYZ": torch.where(alpha > 0, surface.normal, 0.0),
        "depth": (surface.depth * (wo @ backward))[:, None] * there,
        "alpha": alpha,
    }
    channels = {}
    for name, value in values.items():
        layer, _, letters = name.partition(".")
        for k, column in enumerate(value.reshape(views.height, views.width, -1).unbind(-1)):
            channels[f"{layer}.{letters[k]}" if letters else layer] = column
    return channels


def _picture(layers: dict[str, Tensor]) -> Tensor:
    """[H, W, 4] sRGB with straight alpha."""
    rgb = torch.stack([layers[f"rgb.{c}"] for c in "RGB"], -1)
    alpha = layers["alpha"][..., None].clamp(0, 1)
    return torch.cat([linear_to_srgb(rgb / alpha.clamp_min(1e-6)), alpha], -1)


def _read_map(path: Path, rotate: float, exposure: float) -> EnvMap:
    radiance = read_image(path)
    if radiance.dim() == 3 and radiance.shape[2] == 4:
        radiance = radiance[..., :3]  # some writers add an alpha that says nothing
    try:
        return EnvMap(radiance.contiguous(), rotate, exposure)
    except ValueError as error:
        raise DataError(f"{path}: {error}") from None


def _cameras(
    run: Path, cameras: str, resolution: int | None, mesh: Mesh
) -> tuple[list[str], Cameras]:
    """Names of the frames, and their cameras."""
    word, _, count = str(cameras).partition(" ")
    if word == "orbit":
        if count and not (count.isdigit() and int(count)):
            raise ValueError(f"relight: expected orbit or orbit N, N frames, got {cameras!r}")
        frames = int(count or ORBIT_FRAMES)
        names = [f"orbit_{i:04d}" for i in range(frames)]
        return names, orbit(mesh, frames, resolution or ORBIT_SIZE)
    if word == "test":
        photos = load_photos(_trained_on(run), "test")
        names, views = photos.names, photos.cameras
    else:
        names, views = load_cameras(cameras, ORBIT_SIZE)
    return names, _resize(views, resolution or views.width)


def _resize(cameras: Cameras, width: int) -> Cameras:
    """The same views in pictures of another width, in pixels."""
    height = max(1, round(cameras.height * width / cameras.width))
    scale = torch.tensor([width / cameras.width, height / cameras.height])
    return Cameras(
        cameras.camera_to_world, cameras.focal * scale, cameras.centre * scale, width, height
    )


def _trained_on(run: Path) -> Path:
    """The data set that a run's config.json names."""
    path = run / "config.json"
    try:
        return Path(loads(path.read_text(encoding="utf-8"))["data"])
    except (KeyError, TypeError, JSONDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: expected JSON with the key data: {error!r}") from None
