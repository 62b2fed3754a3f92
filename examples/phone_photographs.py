"""Takes the photographs of the tutorial: a painted clay bird on a patchwork cloth.

    python phone_photographs.py bird_photos
    python phone_photographs.py bird_photos --masks bird_masks    # and a perfect mask of each

There is no phone at hand, so this script renders what one would take: JPEG files with the EXIF of a
wide lens and no cameras or masks. Light, path tracer and ray hierarchy are univoxel's own.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from skimage.measure import marching_cubes
from torch.nn.functional import normalize

import univoxel
from univoxel.camera import Cameras, image_rays
from univoxel.color import linear_to_srgb
from univoxel.core.records import Mesh, Surface
from univoxel.envmap import background, read_map, tables
from univoxel.render.relight import Lighting, relight_surface, traced_mesh

MAP = Path(univoxel.__file__).parent / "example_data/tiny/envmaps/train.hdr"
FOCAL_35MM = 32  # mm, of the made-up phone
EXPOSURE = 0.9
CLAY, GLAZE, CREAM, BEAK, WOOD = (
    torch.tensor(color)
    for color in (
        (0.45, 0.17, 0.09),
        (0.03, 0.20, 0.33),
        (0.75, 0.66, 0.48),
        (0.80, 0.33, 0.03),
        (0.30, 0.17, 0.08),
    )
)


def bird(p: torch.Tensor) -> torch.Tensor:
    """Signed distance [N] of points [N, 3] to the bird, about true near its surface."""
    body = ellipsoid(p, (0.0, 0.0, 0.52), (0.52, 0.40, 0.40))
    body = joined(body, ellipsoid(p, (0.40, 0.0, 0.95), (0.25, 0.23, 0.24)), 0.12)
    body = joined(body, ellipsoid(p, (-0.55, 0.0, 0.62), (0.30, 0.16, 0.07)), 0.10)
    side = torch.cat([p[:, :1], p[:, 1:2].abs(), p[:, 2:]], 1)
    body = joined(body, ellipsoid(side, (-0.06, 0.36, 0.56), (0.30, 0.09, 0.18)), 0.04)
    body = joined(body, ellipsoid(p, (0.66, 0.0, 0.92), (0.15, 0.06, 0.05)), 0.03)
    height = (p[:, 2] - 0.085).abs() - 0.085  # a wooden disc below
    ring = torch.stack([p[:, :2].norm(dim=1) - 0.42, height], 1) + 0.03
    disc = ring.clamp_min(0).norm(dim=1) + ring.amax(1).clamp_max(0) - 0.03
    return joined(body, disc, 0.03)


def ellipsoid(p: torch.Tensor, centre: tuple, radii: tuple) -> torch.Tensor:
    q = (p - torch.tensor(centre)) / torch.tensor(radii)
    k = q.norm(dim=1).clamp_min(1e-6)
    return k * (k - 1) / (q / torch.tensor(radii)).norm(dim=1).clamp_min(1e-6)


def joined(a: torch.Tensor, b: torch.Tensor, width: float) -> torch.Tensor:
    """A smooth union."""
    h = (0.5 + 0.5 * (b - a) / width).clamp(0, 1)
    return torch.lerp(b, a, h) - width * h * (1 - h)


def paint(p: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Albedo [N, 3] and roughness [N] of the bird: glaze, a cream breast, dots, feathers."""
    x, y, z = p.unbind(1)
    albedo, roughness = GLAZE.expand(len(p), 3).clone(), torch.full((len(p),), 0.30)

    def put(where: torch.Tensor, color: torch.Tensor, rough: float) -> None:
        albedo[where], roughness[where] = color, rough

    # Dots on a lattice that leans a little, feathers as rings, a breast
    u, v = 9 * (x + 0.3 * z), 9 * (z - 0.2 * x)
    away = torch.stack([u - u.round(), v - v.round()], 1).norm(dim=1)
    put(away < 0.24, CREAM, 0.35)
    wing = torch.stack([(x + 0.06) / 0.30, (z - 0.56) / 0.18], 1).norm(dim=1)
    on_wing = (wing < 1) & (y.abs() > 0.30)
    put(on_wing, CLAY, 0.55)
    put(on_wing & (torch.sin(22 * (x + 0.5 * (z - 0.56).square())) > 0.55), CREAM, 0.55)
    put(((x - 0.55) / 0.35) ** 2 + (y / 0.24) ** 2 + ((z - 0.52) / 0.26) ** 2 < 1, CREAM, 0.45)
    tail = (x < -0.62) & (torch.sin(60 * y) > 0)
    put(tail, CLAY, 0.5)
    put(x > 0.615, BEAK, 0.5)
    eye = torch.stack([x - 0.50, z - 1.02], 1).norm(dim=1)
    put((eye < 0.065) & (y.abs() > 0.05), CREAM, 0.3)
    put((eye < 0.038) & (y.abs() > 0.05), torch.full((3,), 0.02), 0.15)
    disc = (z < 0.2) & (p[:, :2].norm(dim=1) > 0.30) | (z < 0.16)
    put(disc, WOOD, 0.7)
    rings = torch.sin(40 * torch.stack([x + 0.9, y + 0.3], 1).norm(dim=1) + 3 * torch.sin(4 * y))
    albedo[disc] *= (1 + 0.35 * rings[disc])[:, None]
    return albedo, roughness


def cloth(p: torch.Tensor) -> torch.Tensor:
    """Albedo [N, 3] of a patchwork cloth. No two places of it look alike: checks would, and then
    nobody can tell from where a photograph was taken."""
    random = torch.Generator().manual_seed(7)
    place = (p[:, :2] / 3).clamp(-0.999, 0.999)
    cell = ((place + 1) * 13).long()
    patches = 0.12 + 0.5 * torch.rand(26, 26, 1, generator=random)
    patches = patches * (0.8 + 0.4 * torch.rand(26, 26, 3, generator=random))
    albedo = patches[cell[:, 0], cell[:, 1]]
    threads = torch.zeros(len(p), 1)
    for cells, weight in ((60, 0.4), (220, 0.4)):
        table = torch.rand(1, 1, cells, cells, generator=random)
        found = torch.nn.functional.grid_sample(table, place[None, :, None], align_corners=False)
        threads += weight * found[0, 0]
    return albedo * (0.6 + threads)


def scene_mesh(cells: int) -> tuple[Mesh, int]:
    """The bird and the table below it, and how many faces are the bird's."""
    low, high = torch.tensor([-1.0, -0.6, -0.05]), torch.tensor([1.0, 0.6, 1.3])
    step = float((high - low).max()) / cells
    axes = [torch.arange(float(a), float(b), step) for a, b in zip(low, high, strict=True)]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    sdf = bird(grid.reshape(-1, 3)).reshape(grid.shape[:3])
    corners, faces, _, _ = marching_cubes(sdf.numpy(), 0.0, spacing=(step,) * 3)
    vertices = torch.from_numpy(corners.copy()).float() + low
    around = torch.arange(64) * 2 * math.pi / 64
    rim = 3 * torch.stack([around.cos(), around.sin(), 0 * around], 1)
    table = torch.cat([torch.zeros(1, 3), rim])
    first = len(vertices)
    fan = torch.stack(
        [torch.zeros(64).long(), torch.arange(64) + 1, (torch.arange(64) + 1) % 64 + 1], 1
    )
    albedo, roughness = paint(vertices)
    everything = torch.cat([vertices, table])
    return (
        Mesh(
            everything,
            torch.cat([torch.from_numpy(faces.copy()).int(), (fan + first).int()]),
            normals=torch.cat([normals(vertices), torch.tensor([[0.0, 0, 1]]).expand(65, 3)]),
            albedo=torch.cat([albedo, cloth(table)]),
            roughness=torch.cat([roughness, torch.ones(65)]),
        ),
        len(faces),
    )


def normals(p: torch.Tensor) -> torch.Tensor:
    steps = 1e-3 * torch.eye(3)
    return normalize(torch.stack([bird(p + s) - bird(p - s) for s in steps], 1), dim=1)


def walk(photographs: int, width: int, height: int) -> Cameras:
    """Cameras of somebody who walks around the table, every third time with raised arms."""
    random = np.random.default_rng(5)
    poses = []
    for k in range(photographs):
        high = k % 3 == 2
        angle = 2 * math.pi * k / photographs + random.normal(0, 0.03)
        up = math.radians(random.normal(52 if high else 24, 2))
        away = random.normal(2.65, 0.06)
        level = math.cos(up)
        place = away * np.array([math.cos(angle) * level, math.sin(angle) * level, math.sin(up)])
        place[2] += 0.5  # of the bird's middle above the table
        target = np.array([0.02, 0.0, 0.5]) + random.normal(0, 0.03, 3)
        back = (place - target) / np.linalg.norm(place - target)
        right = np.cross([0, 0, 1], back)
        right /= np.linalg.norm(right)
        poses.append(np.stack([right, np.cross(back, right), back, place], 1))
    focal = FOCAL_35MM / 43.27 * math.hypot(width, height)
    return Cameras(
        torch.tensor(np.stack(poses)).float(),
        torch.full((photographs, 2), focal),
        torch.tensor([[width / 2, height / 2]]).expand(photographs, 2).clone(),
        *(width, height),
    )


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description="render the photographs of the tutorial")
    parser.add_argument("out", type=Path, help="folder for IMG_0001.jpg and so on")
    parser.add_argument("--masks", type=Path, help="folder for a perfect mask of each photograph")
    parser.add_argument("--photographs", type=int, default=40, help="all around")
    parser.add_argument("--first", type=int, help="take only this many of them")
    parser.add_argument("--width", type=int, default=960, help="pixels; the height is 3/4 of it")
    parser.add_argument("--samples", type=int, default=16, help="of the light, per pixel")
    options = parser.parse_args()
    for folder in filter(None, (options.out, options.masks)):
        folder.mkdir(parents=True, exist_ok=True)
    width, height = options.width, options.width * 3 // 4
    cameras = walk(options.photographs, 2 * width, 2 * height)  # two samples a pixel each way
    mesh, own = scene_mesh(160)
    traced, light = traced_mesh(mesh, 1e-3), Lighting(tables(read_map(MAP)))
    random = np.random.default_rng(9)
    for view in range(options.first or options.photographs):
        rays = image_rays(cameras, view)
        hit = traced.visibility.closest_hit(rays.origin, rays.direction)
        there = hit.face >= 0
        mine = (hit.face >= 0) & (hit.face < own)
        point = rays.origin + hit.t.nan_to_num(0, 0, 0)[:, None] * rays.direction
        albedo, roughness = cloth(point), torch.ones(len(point))
        albedo[mine], roughness[mine] = paint(point[mine])
        normal = torch.tensor([0.0, 0.0, 1.0]).repeat(len(point), 1)
        corner = mesh.faces[hit.face[mine]].long()
        weight = hit.barycentric[mine]
        weight = torch.cat([1 - weight.sum(1, keepdim=True), weight], 1)
        normal[mine] = normalize((mesh.normals[corner] * weight[..., None]).sum(1), dim=1)
        surface = Surface(
            point, normal, point.new_empty(len(point), 0), albedo, roughness, there.float(), hit.t
        )
        color = relight_surface(
            surface,
            -rays.direction,
            traced,
            light,
            samples=max(1, options.samples // 4),
            bounces=1,
            seed=view,
        )
        color[~there] = background(light.tables, rays.direction[~there])
        picture = color.reshape(height, 2, width, 2, 3).mean((1, 3)) * EXPOSURE
        noisy = linear_to_srgb(picture.clamp(0, 1)).numpy() + random.normal(0, 0.004, picture.shape)
        image = Image.fromarray((255 * noisy.clip(0, 1) + 0.5).astype(np.uint8))
        exif = Image.Exif()
        exif[0x010F], exif[0x0110] = "Example", "Phone"
        exif.get_ifd(0x8769)[0xA405] = FOCAL_35MM
        name = f"IMG_{view + 1:04d}"
        image.save(options.out / f"{name}.jpg", quality=93, exif=exif)
        if options.masks:
            mask = mine.reshape(height, 2, width, 2).float().mean((1, 3)).numpy()
            Image.fromarray((255 * mask + 0.5).astype(np.uint8)).save(options.masks / f"{name}.png")
        print(f"photograph {view + 1} of {options.first or options.photographs}", flush=True)
    print(f"{view + 1} photographs of {width}x{height} in {options.out}")


if __name__ == "__main__":
    main()
