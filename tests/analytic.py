"""An analytic scene for tests: a sphere with a known look, photographed from around it."""

import json
import math
from pathlib import Path

import torch
from PIL import Image

from univoxel import lights
from univoxel.camera import Cameras, image_rays
from univoxel.color import linear_to_srgb
from univoxel.data import Photos
from univoxel.fields.field import dense_field
from univoxel.fields.grid import GridShape, fit_grid
from univoxel.preparation.hull import estimate_bounds, mask_distances, visual_hull
from univoxel.scene import Scene, SceneConfig

RADIUS = 0.5
# Every model of light beside lobes, small
LIGHTS = (
    lights.SHConfig(hidden=16, directions=64, directions_eval=64),
    lights.MLPLightConfig(rank=4, hidden=16, directions=64, directions_eval=64),
    lights.EnvmapSGConfig(lobes=16, rows=16, directions=16, directions_eval=32),
    lights.EnvmapConfig(rows=16, directions=16, directions_eval=32),
    lights.BakedConfig(),
)


def look_at(position: torch.Tensor) -> torch.Tensor:
    """Camera-to-world [3, 4] of a camera at `position` that looks at the origin, +Z up."""
    back = position / position.norm()
    right = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]), back)
    right = right / right.norm()
    return torch.stack([right, torch.linalg.cross(back, right), back, position], 1)


def cameras_at(places: torch.Tensor, size: int, focal: float) -> Cameras:
    """Cameras at places [V, 3] that look at the origin, of square pictures."""
    lens = torch.full((len(places), 2), float(focal)), torch.full((len(places), 2), size / 2)
    return Cameras(torch.stack([look_at(p) for p in places]), *lens, size, size)


def on_circle(views: int, radius: float, height: float) -> torch.Tensor:
    """Places [V, 3] around +Z, from azimuth 0 on."""
    angle = 2 * math.pi * torch.arange(views) / views
    return torch.stack([radius * angle.cos(), radius * angle.sin(), 0 * angle + height], 1)


def cameras_around(views: int, size: int = 32, distance: float = 2.0) -> Cameras:
    """Cameras on a spiral around the origin that see a sphere of radius 0.8 whole."""
    places = []
    for v in range(views):
        z = 0.9 * (1 - 2 * (v + 0.5) / views)
        phi = v * math.pi * (3 - math.sqrt(5))
        r = math.sqrt(1 - z * z)
        places.append([r * math.cos(phi), r * math.sin(phi), z])
    return cameras_at(distance * torch.tensor(places), size, size * distance / 2 / 0.9)


def sphere_normals(cameras: Cameras, view: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Unit normals [H, W, 3] where pixel centres meet the sphere, and the hit mask [H, W]."""
    rays = image_rays(cameras, view)
    b = (rays.origin * rays.direction).sum(1)
    root = b.square() - rays.origin.square().sum(1) + RADIUS**2
    hit = root > 0
    t = -b - root.clamp_min(0).sqrt()
    normal = (rays.origin + t[:, None] * rays.direction) / RADIUS
    shape = (cameras.height, cameras.width)
    return torch.where(hit[:, None], normal, 0.0).reshape(*shape, 3), hit.reshape(shape)


def photograph(cameras: Cameras, view: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Linear colour [H, W, 3] and coverage [H, W] of the sphere under a hemispherical sky.

    Lambertian, brighter above than below (irradiance pi (0.6 + 0.4 n.z)), red on +X and blue on -X.
    """
    normal, hit = sphere_normals(cameras, view)
    side = (normal[..., :1] > 0).float()
    albedo = side * torch.tensor([0.7, 0.2, 0.2]) + (1 - side) * torch.tensor([0.2, 0.2, 0.7])
    return albedo * (0.6 + 0.4 * normal[..., 2:]) * hit[..., None], hit.float()


def write_scene(
    folder: Path, views: int = 12, size: int = 32, gain: torch.Tensor | None = None
) -> Path:
    """The photographs as a data set in the NeRF/Blender layout, train and test.

    Args:
        gain: [views, 3] on the radiance of those to train on.
    """
    for split, count in (("train", views), ("test", 2)):
        cameras = cameras_around(count, size)
        (folder / split).mkdir(parents=True)
        frames = []
        for v in range(count):
            color, alpha = photograph(cameras, v)
            if gain is not None and split == "train":
                color = color * gain[v]
            rgba = torch.cat([linear_to_srgb(color), alpha[..., None]], -1)
            picture = (255 * rgba).round().to(torch.uint8).numpy()
            Image.fromarray(picture).save(folder / split / f"r_{v}.png")
            pose = torch.cat([cameras.camera_to_world[v], torch.tensor([[0.0, 0.0, 0.0, 1.0]])])
            frames.append({"file_path": f"{split}/r_{v}", "transform_matrix": pose.tolist()})
        angle = 2 * math.atan(size / 2 / float(cameras.focal[0, 0]))
        text = json.dumps({"camera_angle_x": angle, "frames": frames})
        (folder / f"transforms_{split}.json").write_text(text)
    return folder


def sphere_scene(
    sky_nodes: int, voxel_size: float = 0.05, seed: int = 0, light: lights.LightConfig | None = None
) -> Scene:
    """A scene whose surface is the sphere, exactly but for the grid; its heads are untrained."""
    torch.manual_seed(seed)
    size = 2 * math.ceil(1.4 * RADIUS / voxel_size) + 1
    axis = (torch.arange(size) - size // 2) * voxel_size
    node = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    grid = GridShape((float(axis[0]),) * 3, voxel_size, (size,) * 3)
    light = light or lights.SGConfig(lobes=2, hidden=4, directions=8, directions_eval=8)
    cfg = SceneConfig(4, material_channels=2, hidden=8, sky_nodes=sky_nodes, light=light)
    return Scene(cfg, dense_field(grid, cfg.channels, node.norm(dim=-1) - RADIUS))


def photos_of(views: int, size: int) -> Photos:
    """The photographs as a loader returns them, in linear float32."""
    cameras = cameras_around(views, size)
    color, alpha = zip(*(photograph(cameras, v) for v in range(views)), strict=True)
    names = [f"r_{v}" for v in range(views)]
    return Photos(Path("sphere"), names, torch.stack(color), torch.stack(alpha), cameras)


def hull_of(photos: Photos) -> tuple[torch.Tensor, GridShape]:
    """The visual hull of photographs, on a small grid around it."""
    distance = mask_distances(photos.coverage())
    grid = fit_grid(*estimate_bounds(distance, photos.cameras), 20000)
    return visual_hull(distance, photos.cameras, grid), grid


def scene_of(albedo, roughness: float, nodes: int, map: torch.Tensor | None = None):
    """The sphere with one material everywhere, under a map [D, 3], or a grey one."""
    scene = sphere_scene(nodes)
    last = scene.material.net[-1]
    low = scene.material.min_roughness
    wanted = torch.tensor([*albedo, (roughness - low) / (1 - low), 0.0])
    with torch.no_grad():
        last.weight.zero_()
        last.bias.copy_(torch.logit(wanted, eps=1e-6))
        if map is not None:
            scene.sky.log_radiance.copy_(map.log())
    return scene
