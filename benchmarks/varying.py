"""Training on light that differs from view to view, against the same scene under one light.

    python benchmarks/varying.py DATA [--preset draft] [--lights sg hybrid] [--kinds ...]

Makes data sets of one, in --work:
- exposure: a random gain per view within +-1 stop; metered: as a camera's automatic would set it,
  towards the same mean brightness in every view, within +-1 stop;
- color: random gains per view and channel within +-1/2 stop;
- relit: the photographs rendered again by univoxel's own path tracer, under the training map, from
  the data set's mesh with the albedo and roughness of the nearest pixels of its test views;
- turned: the same, with the map turning with the camera about +Z, as on a turntable.
Test views and all ground truth stay as they are. Then trains each kind without and with --varying
and evaluates; what is done already is not done again.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from made import made
from scipy import ndimage, spatial
from torch.nn.functional import normalize

from lab.record import result_text
from univoxel.camera import image_rays
from univoxel.cli.evaluate import evaluate
from univoxel.cli.trainer import train
from univoxel.color import linear_to_srgb, luminance
from univoxel.core.files import replacing
from univoxel.core.records import Mesh, Surface
from univoxel.data import Photos, load_photos, load_truth
from univoxel.data.images import write_png
from univoxel.data.truth import read_ply
from univoxel.envmap import read_map, tables
from univoxel.presets import preset
from univoxel.render.relight import Lighting, relight_surface, rotated, traced_mesh
from univoxel.scene import FILE, load_scene

# kind: what it is compared with, and the models that are trained on it
KINDS = {
    "fixed": ("fixed", ["none", "light"]),
    "exposure": ("fixed", ["none", "exposure"]),
    "metered": ("fixed", ["none", "exposure"]),
    "color": ("fixed", ["none", "exposure"]),
    "relit": ("relit", ["none"]),
    "turned": ("relit", ["none", "light"]),
}
NEAREST = 4  # pixels of test views that a material is the mean of
SAMPLES = 128  # of the light in a rendered photograph


def gains(kind: str, folder: Path, seed: int = 0) -> torch.Tensor:
    """Factors [V, 3] on the linear colour of the training photographs, of geometric mean 1."""
    generator, photos = torch.Generator().manual_seed(seed), load_photos(folder, "train")
    views = len(photos)
    stops = torch.zeros(views, 3)
    if kind == "exposure":
        stops = (2 * torch.rand(views, 1, generator=generator) - 1).expand(-1, 3)
    elif kind == "metered":
        means = []
        for v in range(views):
            color, alpha = photos.picture(v)
            means.append(luminance(color[alpha > 0.5]).mean())
        stops = -torch.stack(means).log2()
        stops = (stops - stops.mean()).clamp(-1, 1)[:, None].expand(-1, 3)
    elif kind == "color":
        stops = torch.rand(views, 3, generator=generator) - 0.5
    return 2 ** (stops - stops.mean(0))


def exposed(photos: Photos, gain: torch.Tensor) -> torch.Tensor:
    """Photographs [V, H, W, 3] uint8 under gains [V, 3]. What was clipped stays so."""
    assert photos.color.dtype == torch.uint8
    out = torch.empty_like(photos.color)
    for v in range(len(photos)):
        color, _ = photos.picture(v)
        encoded = linear_to_srgb(color * gain[v])
        encoded[photos.color[v] >= 253] = 1.0
        out[v] = (255 * encoded).round().to(torch.uint8)
    return out


def materials(folder: Path):
    """Function from world points [P, 3] to albedo [P, 3] and roughness [P] of the truth there."""
    test = load_photos(folder, "test")
    points, values = [], []
    for v in range(len(test)):
        truth, rays = load_truth(test, v), image_rays(test.cameras, v)
        inside = truth.mask.flatten() & (truth.depth.flatten() > 0)
        forward = -test.cameras.camera_to_world[v, :, 2]
        t = truth.depth.flatten() / (rays.direction @ forward)
        points.append((rays.origin + t[:, None] * rays.direction)[inside])
        values.append(torch.cat([truth.albedo, truth.roughness[..., None]], -1).view(-1, 4)[inside])
    tree, values = spatial.cKDTree(torch.cat(points).numpy()), torch.cat(values)

    def at(place: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        _, index = tree.query(place.numpy(), k=NEAREST)
        mean = values[torch.from_numpy(np.asarray(index))].mean(1)
        return mean[:, :3], mean[:, 3]

    return at


def rendered(folder: Path, photos: Photos, degrees: torch.Tensor) -> torch.Tensor:
    """Photographs [V, H, W, 3] uint8 of the true mesh, the training map turned by degrees [V]."""
    mesh, at = read_ply(folder / "mesh.ply"), materials(folder)
    corner = mesh.faces.long()
    a, b, c = mesh.vertices[corner].unbind(1)
    area = torch.linalg.cross(b - a, c - a)
    normals = torch.zeros_like(mesh.vertices)
    for k in range(3):
        normals.index_add_(0, corner[:, k], area)
    normals = normalize(normals, dim=1)
    albedo, roughness = at(mesh.vertices)
    here = traced_mesh(Mesh(mesh.vertices, mesh.faces, normals, albedo, roughness), 1e-3)
    light = Lighting(tables(read_map(folder / "envmaps" / "train.hdr")))
    out = torch.zeros_like(photos.color)
    for v in range(len(photos)):
        rays = image_rays(photos.cameras, v)
        hit = here.visibility.closest_hit(rays.origin, rays.direction)
        met = hit.face >= 0
        place = (rays.origin + hit.t[:, None] * rays.direction)[met]
        corners = corner[hit.face[met].long()]
        near = (mesh.vertices[corners] - place[:, None]).norm(dim=2)
        weight = barycentric(place, *mesh.vertices[corners].unbind(1))
        wo = -rays.direction[met]
        normal = normalize((weight[..., None] * normals[corners]).sum(1), dim=1)
        normal = torch.where((normal * wo).sum(1, keepdim=True) < 0, -normal, normal)
        albedo, roughness = at(place)
        one = torch.ones(len(place))
        surface = Surface(place, normal, near, albedo, roughness, one, one)
        options = {"samples": SAMPLES, "bounces": 2, "seed": v}
        rgb = relight_surface(surface, wo, here, rotated(light, float(degrees[v])), **options)
        picture, there = torch.zeros(len(met), 3), met.view(photos.alpha.shape[1:]).numpy()
        picture[met] = linear_to_srgb(rgb)
        # Where a pixel's middle misses the mesh, the nearest one that does not is in
        _, nearest = ndimage.distance_transform_edt(~there, return_indices=True)
        row, column = (torch.from_numpy(n) for n in nearest)
        out[v] = (255 * picture.view(*there.shape, 3)[row, column]).round().to(torch.uint8)
    return out


def barycentric(p, a, b, c) -> torch.Tensor:
    """Weights [N, 3] of the corners at points of triangles."""

    def twice_area(x, y, z):
        return torch.linalg.cross(y - x, z - x).norm(dim=1)

    parts = torch.stack([twice_area(p, b, c), twice_area(p, c, a), twice_area(p, a, b)], 1)
    return parts / parts.sum(1, keepdim=True).clamp_min(1e-12)


def make(folder: Path, kind: str, out: Path) -> Path:
    """The data set of a kind, which shares everything but the training photographs."""
    if kind == "fixed":
        return folder
    if (out / "transforms_train.json").is_file():
        return out
    photos = load_photos(folder, "train")
    if kind in ("relit", "turned"):
        x, y = photos.cameras.camera_to_world[:, :2, 3].unbind(1)
        color = rendered(folder, photos, torch.atan2(y, x).rad2deg() * (kind == "turned"))
    else:
        color = exposed(photos, gains(kind, folder))
    shutil.copytree(folder, out, ignore=shutil.ignore_patterns("train"), dirs_exist_ok=True)
    frames = json.loads((folder / "transforms_train.json").read_text())
    (out / "transforms_train.json").unlink()
    for v, frame in enumerate(frames["frames"]):
        rgba = torch.cat([color[v], photos.alpha[v][..., None]], -1)
        path = out / Path(frame["file_path"]).with_suffix(".png")
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, rgba.numpy())
    (out / "transforms_train.json").write_text(json.dumps(frames))  # last: now it is whole
    return out


def gain_error(run: Path, folder: Path, kind: str) -> float | None:
    """Root mean square error of the recovered gains, in stops; None if the run has none."""
    views = load_scene(run).views
    if views is None or KINDS[kind][0] != "fixed":
        return None
    true = gains(kind, folder).log2()
    return float((views.log_gain.detach() / math.log(2) - true).square().mean().sqrt())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--lights", nargs="+", default=["sg", "hybrid"])
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS))
    models = ["none", "exposure", "light"]
    parser.add_argument("--varying", nargs="+", default=models, choices=models)
    parser.add_argument("--minutes", type=float, default=60.0, help="so many that steps decide")
    parser.add_argument("--work", type=Path, default=Path("build/varying"))
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results/varying.json")
    arguments = parser.parse_args()
    result = json.loads(arguments.out.read_text()) if arguments.out.is_file() else {"runs": {}}
    for light in arguments.lights:
        for kind in arguments.kinds:
            data = make(arguments.data, kind, arguments.work / f"{arguments.data.name}_{kind}")
            for varying in (m for m in KINDS[kind][1] if m in arguments.varying):
                name = f"{arguments.data.name} {arguments.preset} {light} {kind} {varying}"
                if name in result["runs"]:
                    continue
                run = arguments.work / name.replace(" ", "_")
                cfg = preset(arguments.preset, data, run, light, varying)
                train(replace(cfg, minutes=arguments.minutes), resume=(run / FILE).is_file())
                own = evaluate(run, samples=32) | {
                    "gain_stops": gain_error(run, arguments.data, kind)
                }
                result["runs"][name] = own | {"commit": made()["commit"]}
                with replacing(arguments.out) as temporary:
                    temporary.write_text(result_text(result | made()))
                print(name, f"albedo {own['albedo_psnr_3ch']:.2f} relit {own['relit_psnr']:.2f}")


if __name__ == "__main__":
    main()
