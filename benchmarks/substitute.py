"""What holds the quality back: the truth in place of one term at a time, on scenes that have it.

    python benchmarks/substitute.py SCENE [SCENE ...] --out DIR [--preset fast] [--terms none]

In training, `geometry` gives the true surface as the sdf and keeps it, `light` the true map; `both`
does both, and what is left are the materials and the shading. In relighting the trained scene's
pixels take true albedo, roughness or normals, or the true mesh casts the shadows. Runs are kept in
DIR and not made again. Writes DIR/substitute.json and .md.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from made import made
from relight_scenes import true_mesh
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree
from torch import Tensor
from trimesh.triangles import closest_point

from lab.record import result_text
from univoxel import lights
from univoxel.camera import image_rays
from univoxel.cli.evaluate import evaluate
from univoxel.cli.trainer import train
from univoxel.color import linear_to_srgb
from univoxel.config import JointConfig, StageConfig, TrainConfig, save_config
from univoxel.core.records import Mesh, Surface
from univoxel.data import load_photos, load_relit, load_truth, relight_maps
from univoxel.data.photos import decode
from univoxel.envmap import read_map, tables, true_map
from univoxel.evaluation.measures import albedo_scales
from univoxel.fields.field import dense_field
from univoxel.fields.grid import GridShape, fit_grid
from univoxel.lights.latlong import DistantLight
from univoxel.ops import VisibilityScene
from univoxel.output.mesh import with_materials
from univoxel.preparation.hull import estimate_bounds, mask_distances, visual_hull
from univoxel.presets import preset
from univoxel.render.metrics import on_black, psnr
from univoxel.render.pipeline import extract_mesh, surface_of_view
from univoxel.render.relight import Lighting, relight_surface, traced_mesh
from univoxel.scene import Scene, load_scene, save_scene
from univoxel.sphere import latlong_directions, texel_solid_angles

TERMS = ("none", "geometry", "light", "both")
NEIGHBOURS = 4  # samples of the surface whose triangles a node is measured to
STILL = 1e-9  # a learning rate that moves nothing
SHOWN = (
    "nvs_psnr", "albedo_psnr_3ch", "roughness_mse", "relit_psnr", "normal_mae_deg"
)  # fmt: skip
PIXELS = ("albedo", "roughness", "normal", "mesh")


def true_sdf(folder: Path, grid: GridShape) -> Tensor:
    """Signed distance [X, Y, Z] of a data set's mesh, cut off at six voxels.

    Walls thinner than two voxels are lost between the nodes, as in any field on this grid.
    """
    vertices, faces, _ = true_mesh(folder)
    corner = vertices[faces.long()]
    area = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).norm(dim=1)
    count = int(20 * area.sum() / grid.voxel_size**2)
    g = torch.Generator().manual_seed(0)
    face = torch.multinomial(area / area.sum(), count, replacement=True, generator=g)
    weight = torch.distributions.Dirichlet(torch.ones(3)).sample((count,))
    points = (corner[face] * weight[..., None]).sum(1)
    nodes = grid.nodes()
    index = ((points - torch.tensor(grid.origin)) / grid.voxel_size).round().long()
    near = torch.zeros(grid.size, dtype=torch.bool)
    limit = torch.tensor(grid.size) - 1
    near[tuple(index.clamp_min(0).minimum(limit).T)] = True
    band = torch.from_numpy(binary_dilation(near.numpy(), iterations=6))
    sdf = torch.full(grid.size, 6 * grid.voxel_size)
    near_to, tree = nodes[band].numpy(), cKDTree(points.numpy())
    _, nearest = tree.query(near_to, NEIGHBOURS)
    best = np.full(len(near_to), np.inf)
    for k in range(NEIGHBOURS):  # exact to the triangles of the nearest samples
        triangles = corner[face[nearest[:, k]]].numpy()
        foot = closest_point(triangles, near_to)
        best = np.minimum(best, np.linalg.norm(foot - near_to, axis=1))
    sdf[band] = torch.from_numpy(best).float()
    return torch.where(inside(vertices, faces, nodes.reshape(-1, 3)).view(grid.size), -sdf, sdf)


def inside(vertices: Tensor, faces: Tensor, points: Tensor) -> Tensor:
    """[P] bool: most rays from a point leave through the back of the face that they meet first."""
    scene = VisibilityScene(vertices, faces)
    corner = vertices[faces.long()]
    normal = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    votes = torch.zeros(len(points))
    for direction in torch.nn.functional.normalize(
        torch.tensor([[0.1, 0.2, 1], [1, 0.1, 0.2], [0.2, 1, 0.1], [-1, 0.3, 0.2], [0.1, -1, 0.3]])
    ):
        face = scene.closest_hit(points, direction.expand_as(points).contiguous()).face.long()
        votes += (face >= 0) & (normal[face.clamp_min(0)] @ direction > 0)
    return votes >= 3


def at_nodes(radiance: Tensor, sky: DistantLight) -> Tensor:
    """Mean radiance [D, 3] of a map's texels that lie nearest to each direction of the sky."""
    wi = latlong_directions(len(radiance)).reshape(-1, 3)
    weight = texel_solid_angles(*radiance.shape[:2]).reshape(-1, 1)
    node = torch.cat([(w @ sky.direction.T).argmax(1) for w in wi.split(65536)])
    total = torch.zeros(len(sky.direction), 3).index_add(0, node, weight * radiance.reshape(-1, 3))
    return total / torch.zeros(len(total), 1).index_add(0, node, weight).clamp_min(1e-12)


def begin(folder: Path, out: Path, name: str, term: str) -> TrainConfig:
    """A run that begins with the truth in place of a term, and stays with it."""
    cfg = preset(name, folder, out)
    cfg = replace(cfg, minutes=60.0)  # by steps only: other work must not change the result
    photos = load_photos(folder, "train")
    distance = mask_distances(photos.coverage())
    lower, upper = estimate_bounds(distance, photos.cameras)
    stages = list(cfg.stages)
    if term in ("geometry", "both"):  # one grid for all stages: resampling would round it off
        still = {"lr_sdf": (STILL, STILL), "plate": 0.0, "spread": 0}
        stages = [
            replace(s, **(still if isinstance(s, StageConfig) else {"lr_sdf": 0.0}))
            for s in stages[1:]
        ]
    if term in ("light", "both"):
        fixed = {"lr_map": STILL, "newton_steps": 0}
        stages = [replace(s, **fixed) if isinstance(s, JointConfig) else s for s in stages]
    cfg = replace(cfg, stages=tuple(stages))
    first = cfg.stages[0]
    assert isinstance(first, StageConfig)
    grid = fit_grid(lower, upper, round(1e6 * first.voxels))
    exact = term in ("geometry", "both")
    sdf = true_sdf(folder, grid) if exact else visual_hull(distance, photos.cameras, grid)
    light = lights.scaled(cfg.scene.light, float((upper - lower).max()) / 2)
    torch.manual_seed(cfg.seed)
    scene = Scene(replace(cfg.scene, light=light), dense_field(grid, cfg.scene.channels, sdf))
    radiance = true_map(folder)
    if term in ("light", "both") and radiance is not None:
        assert scene.sky is not None
        with torch.no_grad():
            scene.sky.log_radiance.copy_(at_nodes(radiance, scene.sky).clamp_min(1e-4).log())
    out.mkdir(parents=True, exist_ok=True)
    save_config(cfg)
    save_scene(scene, out, {"stage": 0, "progress": 0.0, "step": 0, "seconds": 0.0})
    return cfg


@torch.no_grad()
def relit_with_true_pixels(run: Path, folder: Path, samples: int = 64) -> dict[str, float]:
    """relit_psnr of a run, its pixels' terms replaced by the truth one by one, and all at once."""
    scene, photos = load_scene(run), load_photos(folder, "test")
    scale = albedo_scales(scene, photos).three
    own = extract_mesh(scene)
    assert own.albedo is not None
    own = replace(own, albedo=(own.albedo * scale).clamp_max(1))
    vertices, faces, normals = true_mesh(folder)
    other = with_materials(scene, Mesh(vertices, faces))
    assert other.albedo is not None
    other = replace(other, normals=normals, albedo=(other.albedo * scale).clamp_max(1))
    stages = {m: traced_mesh(mesh, scene.field.voxel_size) for m, mesh in ((0, own), (1, other))}
    maps = {name: Lighting(tables(read_map(path))) for name, path in relight_maps(folder).items()}
    wanted = {name: load_relit(photos, name) for name in maps}
    found: dict[str, list[float]] = {}
    for view in range(len(photos)):
        surface, wo = surface_of_view(scene, photos.cameras, view)
        surface = replace(surface, albedo=(surface.albedo * scale).clamp_max(1))
        true = of_truth(surface, load_truth(photos, view), photos.cameras, view)
        for key in ("nothing", *PIXELS, "all"):
            terms = set(PIXELS) if key == "all" else {key}
            here = replace(surface, **{k: v for k, v in true.items() if k in terms})
            if "mesh" in terms:
                here = replace(here, position=true["position"])
            for map, lighting in maps.items():
                options = {"samples": samples, "bounces": 2}
                rgb = relight_surface(here, wo, stages["mesh" in terms], lighting, **options)
                picture = on_black(*decode(*(part[view] for part in wanted[map])))
                made = linear_to_srgb(rgb * here.opacity[:, None]).view_as(picture)
                found.setdefault(key, []).append(psnr(made, picture))
    return {key: fmean(values) for key, values in found.items()}


def of_truth(surface: Surface, truth, cameras, view: int) -> dict[str, Tensor]:
    """The true fields of a view's pixels, and the surface's own if there is no truth."""
    there = truth.mask.reshape(-1) & (surface.opacity > 0.5)
    rays = image_rays(cameras, view)
    along = -(rays.direction @ cameras.camera_to_world[view, :, 2])
    t = truth.depth.reshape(-1) / along
    true = {
        "albedo": truth.albedo.reshape(-1, 3),
        "roughness": truth.roughness.reshape(-1),
        "normal": torch.nn.functional.normalize(truth.normal.reshape(-1, 3), dim=1),
        "position": rays.origin + t[:, None] * rays.direction,
    }
    return {
        k: torch.where(there[:, None] if v.dim() == 2 else there, v, getattr(surface, k))
        for k, v in true.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--terms", nargs="+", choices=TERMS, default=TERMS)
    options = parser.parse_args()
    path = options.out / "substitute.json"
    result = json.loads(path.read_text()) if path.is_file() else {}
    for folder in options.scenes:
        own = result.setdefault(folder.name, {"preset": options.preset})
        for term in options.terms:
            run = options.out / f"{folder.name}_{options.preset}_{term}"
            if term not in own:
                train(begin(folder, run, options.preset, term), resume=True)
                measured = evaluate(run)
                own[term] = {k: measured[k] for k in SHOWN}
            if term == "none" and "relit" not in own:
                own["relit"] = relit_with_true_pixels(run, folder)
            path.write_text(result_text(result | made()))
    path.with_suffix(".md").write_text(table(result))
    print(table(result))


def table(result: dict) -> str:
    lines = [f"| scene | truth given in training | {' | '.join(SHOWN)} |", "|---" * 7 + "|"]
    for scene, own in result.items():
        for term in (t for t in TERMS if t in own):
            values = " | ".join(f"{own[term][k]:.4g}" for k in SHOWN)
            lines.append(f"| {scene} | {term} | {values} |")
    keys = ("nothing", *PIXELS, "all")
    lines += ["", f"| scene, relit_psnr with true | {' | '.join(keys)} |", "|---" * 7 + "|"]
    for scene, own in result.items():
        if "relit" in own:
            values = " | ".join(f"{own['relit'][k]:.1f}" for k in keys)
            lines.append(f"| {scene} | {values} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
