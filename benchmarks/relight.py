"""Relighting: error against time and samples, against Mitsuba 3, and against rendered pictures.

python benchmarks/relight.py OUT.json [--data SCENE]

SCENE is a folder with mesh.ply, envmaps/, relight/ and per-pixel truth in test/gt. Without it only
the table of strategies is measured, on a sphere over a plane. Needs trimesh with --data, and for
the comparison mitsuba and DRJIT_LIBLLVM_PATH.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from univoxel import brdf
from univoxel.camera import image_rays
from univoxel.color import linear_to_srgb, srgb_to_linear
from univoxel.data import load_photos
from univoxel.data.images import read_image
from univoxel.envmap import EnvMap, tables
from univoxel.ops import VisibilityScene, relight
from univoxel.records import Mesh

TESTS = Path(__file__).parent.parent / "tests"
SPP = [1, 4, 16, 64, 256, 1024]
TRUTH_SPP = 8192


def psnr(a: Tensor, b: Tensor) -> float:
    return float(-10 * torch.log10((a - b).square().mean()))


def timed(work) -> tuple[Tensor, float]:
    start = time.perf_counter()
    result = work()
    return result, time.perf_counter() - start


def sphere_scene(size: int) -> dict:
    """Points that a camera sees of the sphere over a plane of the tests, and its light."""
    sys.path[:0] = [str(TESTS), str(TESTS / "ops")]
    import test_integrator_mitsuba as shared

    vertices, faces, normals, part = shared.sphere_on_plane()
    y, x = torch.meshgrid(*[torch.linspace(-0.45, 0.45, size)] * 2, indexing="ij")
    direction = torch.nn.functional.normalize(
        torch.stack([x, torch.ones_like(x), -0.25 - y], -1).reshape(-1, 3), dim=1
    )
    origin = torch.tensor([0.0, -5.0, 0.9]).expand_as(direction).contiguous()
    scene = VisibilityScene(vertices, faces)
    hit = scene.closest_hit(origin, direction)
    met = hit.face >= 0
    corner = faces.long()[hit.face[met]]
    u, v = hit.barycentric[met].unbind(1)
    weight = torch.stack([1 - u - v, u, v], 1)[..., None]
    kind = part[corner[:, 0]]
    cosine = torch.linspace(0, 1, 1025)
    light = EnvMap(shared.sky_map(256, math.pi / 2 - math.pi * (torch.arange(256) + 0.5) / 256))
    return {
        "ours": (
            scene,
            Mesh(vertices, faces, normals, shared.ALBEDO[part], shared.ROUGHNESS[part]),
            tables(light),
            origin[met] + hit.t[met, None] * direction[met],
            torch.nn.functional.normalize((weight * normals[corner]).sum(1), dim=1),
            -direction[met],
            shared.ALBEDO[kind],
            shared.ROUGHNESS[kind],
        ),
        "theirs": {
            "vertices": vertices,
            "faces": faces,
            "normals": normals,
            "part": part,
            "albedo": shared.ALBEDO,
            "roughness": shared.ROUGHNESS,
            "layer": torch.stack(
                [brdf.specular_albedo(cosine, r.expand(1025)) for r in shared.ROUGHNESS]
            ),
            "radiance": shared.sky_map(256, math.pi / 2 - math.pi * torch.arange(256) / 255),
            "origin": origin[met],
            "direction": direction[met],
            "bounces": 3,
        },
    }


def strategies(scene: dict) -> list[dict]:
    """Relative root mean square error and time by strategy and samples per pixel."""
    common = {"offset": 1e-3, "bounces": 2}
    truth = relight(*scene["ours"], samples=TRUTH_SPP, seed=1, **common)
    rows = []
    for name in ("mis", "map", "brdf"):
        for samples in SPP:
            options = common | {"samples": samples, "strategy": name}
            rgb, seconds = timed(lambda o=options: relight(*scene["ours"], **o))
            error = float((rgb - truth).square().mean().sqrt() / truth.mean())
            rows.append({"strategy": name, "spp": samples, "error": error, "seconds": seconds})
    return rows


def against_mitsuba(scene: dict) -> dict | None:
    """PSNR between the two at many samples; time of both at equal error. None: it cannot run."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)

        def theirs(samples: int) -> tuple[Tensor, float] | None:
            np.savez(
                path / "in.npz",
                **{k: np.asarray(v) for k, v in scene["theirs"].items()},
                samples=samples,
            )
            done = subprocess.run(
                [
                    sys.executable,
                    str(TESTS / "mitsuba_reference.py"),
                    path / "in.npz",
                    path / "o.npy",
                ],
                capture_output=True,
                text=True,
                check=False,
            )
            if done.returncode:
                print(f"mitsuba: {done.stderr.strip()[-200:]}", file=sys.stderr)
                return None
            return torch.from_numpy(np.load(path / "o.npy")), _seconds(done.stderr)

        many = theirs(4096)
        if many is None:
            return None
        common = {"offset": 1e-3, "bounces": 3}
        ours, _ = timed(lambda: relight(*scene["ours"], samples=TRUTH_SPP, seed=1, **common))
        agreement = psnr(ours.clamp_max(1), many[0].clamp_max(1))
        few = theirs(256)
        assert few is not None
        wanted = float((few[0] - ours).square().mean())
        for samples in SPP:
            rgb, seconds = timed(lambda n=samples: relight(*scene["ours"], samples=n, **common))
            if float((rgb - ours).square().mean()) <= wanted:
                break
    return {
        "psnr_at_many_samples": agreement,
        "error": math.sqrt(wanted),
        "mitsuba": {"spp": 256, "seconds": few[1]},
        "univoxel": {"spp": samples, "seconds": seconds},
    }


def _seconds(stderr: str) -> float:
    """Time of rendering alone, which the script reports after warming up."""
    return float(stderr.rpartition("seconds ")[2].split()[0])


def against_pictures(folder: Path, samples: int, every: int) -> list[dict]:
    """Test views relit from the true surface, against pictures of another renderer.

    The true mesh has no materials: each vertex takes the mean truth of the pixels that see it best,
    vertices that no test view sees those of the nearest that are seen. Pixels are shaded with their
    own truth; at silhouettes by their coverage.
    """
    import trimesh
    from scipy.spatial import cKDTree

    photos = load_photos(folder, "test")
    loaded = trimesh.load(folder / "mesh.ply", process=False)
    vertices = torch.tensor(np.asarray(loaded.vertices), dtype=torch.float32)
    faces = torch.tensor(np.asarray(loaded.faces), dtype=torch.int32)
    scene = VisibilityScene(vertices, faces)
    truths = []
    for view, name in enumerate(photos.names):
        truth = dict(np.load(folder / "test" / "gt" / f"{name}.npz"))
        rays = image_rays(photos.cameras, view)
        depth = torch.from_numpy(truth["depth"]).reshape(-1)
        backward = photos.cameras.camera_to_world[view, :, 2]
        t = depth / -(rays.direction @ backward)
        flat = {
            k: torch.from_numpy(truth[k].astype(np.float32)).reshape(len(t), -1)
            for k in ("albedo", "roughness", "normal", "alpha")
        }
        met = (depth > 0) & (flat["alpha"][:, 0] > 0)
        flat["alpha"] /= 255
        position = rays.origin + t[:, None] * rays.direction
        truths.append((met, position, -rays.direction, flat))
    seen = torch.cat([p[m & (f["alpha"][:, 0] > 0.98)] for m, p, _, f in truths])
    known = torch.cat(
        [
            torch.cat([f["albedo"], f["roughness"]], 1)[m & (f["alpha"][:, 0] > 0.98)]
            for m, _, _, f in truths
        ]
    )
    _, nearest = cKDTree(seen.numpy()).query(vertices.numpy(), k=4)
    material = known[torch.from_numpy(nearest)].mean(1)
    normals = torch.tensor(np.asarray(loaded.vertex_normals).copy(), dtype=torch.float32)
    mesh = Mesh(vertices, faces, normals, material[:, :3].contiguous(), material[:, 3].contiguous())
    rows = []
    for path in sorted((folder / "envmaps").glob("*.hdr")):
        if not (folder / "relight" / path.stem).is_dir():
            continue
        light = tables(EnvMap(read_image(path)))
        for bounces in (0, 1, 3):
            scores = []
            for view in range(0, len(photos), every):
                met, position, wo, flat = truths[view]
                rgb = torch.zeros_like(position)
                rgb[met] = relight(
                    scene,
                    mesh,
                    light,
                    position[met],
                    torch.nn.functional.normalize(flat["normal"][met], dim=1),
                    wo[met],
                    flat["albedo"][met],
                    flat["roughness"][met, 0],
                    offset=1e-3,
                    samples=samples,
                    bounces=bounces,
                )
                picture = read_image(folder / "relight" / path.stem / f"{photos.names[view]}.png")
                picture = picture.reshape(-1, 4).float() / 255
                alpha = flat["alpha"]
                # Files hold straight sRGB: both on black in linear light, then compared as sRGB.
                wanted = linear_to_srgb(srgb_to_linear(picture[:, :3]) * picture[:, 3:])
                scores.append(psnr(linear_to_srgb(rgb.clamp(0, 1) * alpha), wanted))
            rows.append({"map": path.stem, "bounces": bounces, "psnr": sum(scores) / len(scores)})
            print(rows[-1], flush=True)
    return rows


def draw(path: Path) -> None:
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    rows = json.loads(path.read_text())["strategies"]
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True)
    for name in ("mis", "map", "brdf"):
        own = [r for r in rows if r["strategy"] == name]
        for axis, key in zip(axes, ("spp", "seconds"), strict=True):
            axis.loglog([r[key] for r in own], [r["error"] for r in own], "o-", label=name)
    axes[0].set_xlabel("samples per pixel")
    axes[0].set_ylabel("RMS error over mean radiance")
    axes[1].set_xlabel("seconds")
    axes[1].legend()
    figure.tight_layout()
    figure.savefig(path.with_suffix(".png"), dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--size", type=int, default=96, help="pixels along the sphere's picture")
    parser.add_argument("--samples", type=int, default=256, help="per pixel of the pictures")
    parser.add_argument("--every", type=int, default=1, help="take every n-th test view")
    arguments = parser.parse_args()
    scene = sphere_scene(arguments.size)
    result = {
        "threads": torch.get_num_threads(),
        "load": os.getloadavg()[0],
        "pixels": len(scene["ours"][3]),
        "strategies": strategies(scene),
        "mitsuba": against_mitsuba(scene),
    }
    print(result["mitsuba"], flush=True)
    if arguments.data:
        result["pictures"] = against_pictures(arguments.data, arguments.samples, arguments.every)
    arguments.out.write_text(json.dumps(result, indent=1) + "\n")
    draw(arguments.out)


if __name__ == "__main__":
    main()
