"""A scene without any symmetry, whose materials are known functions of position."""

import math

import torch
from analytic import cameras_at

from univoxel.camera import Cameras
from univoxel.color import linear_to_srgb
from univoxel.core.records import Surface
from univoxel.envmap import EnvMap
from univoxel.fields.field import dense_field
from univoxel.fields.grid import fit_grid
from univoxel.lights import SGConfig
from univoxel.render.relight import traced_mesh
from univoxel.scene import Scene, SceneConfig
from univoxel.sphere import direction_at, latlong_directions
from univoxel.viewer.viewer_scene import Subject, mesh_of

# Balls of these centres and radii, united.
BALLS = torch.tensor([[0.0, 0, 0, 0.4], [0.35, 0.1, 0, 0.2], [0, 0.1, 0.4, 0.15]])


def sdf(points: torch.Tensor) -> torch.Tensor:
    distances = (points[..., None, :] - BALLS[:, :3]).norm(dim=-1) - BALLS[:, 3]
    return distances.amin(-1)


def albedo(points: torch.Tensor) -> torch.Tensor:
    """Linear in the position: trilinear interpolation of it is exact."""
    return 0.5 + points * torch.tensor([0.6, -0.5, 0.4])


def roughness(points: torch.Tensor) -> torch.Tensor:
    return 0.5 + 0.5 * points[..., 2]


class Identity(torch.nn.Module):
    """The features are the materials; no metal."""

    def forward(self, features):
        return features[:, :3], features[:, 3], torch.zeros(len(features))


class Metals(torch.nn.Module):
    """The features are the materials; metal where the albedo is reddest."""

    def forward(self, features):
        metal = torch.sigmoid(40 * (features[:, 0] - 0.65))
        return features[:, :3], features[:, 3], metal


def lamp() -> EnvMap:
    """A wide warm light at +X, dim blue all round."""
    towards = torch.tensor([math.cos(0.5), 0.0, math.sin(0.5)])
    power = 6 * ((latlong_directions(32) @ towards - 1) / 0.15).exp()
    return EnvMap(power[..., None] * torch.tensor([1.0, 0.9, 0.7]) + torch.tensor([0.1, 0.12, 0.2]))


def lopsided(voxels: int = 48**3, change=None, light=None) -> Scene:
    """The scene; `change(points, sdf)` gives another sdf at the grid's nodes."""
    grid = fit_grid(torch.tensor([-0.5, -0.5, -0.5]), torch.tensor([0.65, 0.5, 0.65]), voxels)
    nodes = grid.nodes()
    distance = sdf(nodes) if change is None else change(nodes, sdf(nodes))
    field = dense_field(grid, 4, distance)
    with torch.no_grad():
        field.features.copy_(torch.cat([albedo(nodes), roughness(nodes)[..., None]], -1))
    cfg = SceneConfig(channels=4, material_channels=2, hidden=8, light=light or SGConfig())
    scene = Scene(cfg, field, inv_s=100.0)
    scene.material = Identity()
    return scene.eval()


def looking(azimuth: float, elevation: float, size: int, focal: float) -> Cameras:
    """A camera in the distance that looks at the object; its focal length in widths."""
    cameras = cameras_at(3.0 * torch.tensor([direction_at(azimuth, elevation)]), size, focal * size)
    cameras.camera_to_world[:, :, 3] += torch.tensor([0.08, 0.0, 0.08])
    return cameras


def layers_of(surface: Surface) -> dict[str, torch.Tensor]:
    """What a picture of each of its layers shows of it."""
    return {
        "albedo": linear_to_srgb(surface.albedo),
        "roughness": surface.roughness[:, None].expand(-1, 3),
        "metal": surface.metallic[:, None].expand(-1, 3),
        "normal": 0.5 * surface.normal + 0.5,
    }


def with_metal() -> Scene:
    scene = lopsided()
    scene.material = Metals()
    scene.inv_s = 600.0  # silhouettes as sharp as after a training
    return scene


def subject_of(scene: Scene) -> Subject:
    """What the viewer shows of a scene."""
    return Subject(scene, traced_mesh(mesh_of(scene), scene.field.voxel_size))
