"""Relighting: error against time and samples, ray rates, Mitsuba 3, and rendered pictures.

python benchmarks/relight.py OUT.json [--data SCENE] [--only rays,strategies,mitsuba,pictures]

SCENE is a folder with mesh.ply, envmaps/, relight/ and per-pixel truth in test/gt; it needs
trimesh. Without it the scene is a sphere over a plane, and there are no pictures. The comparison
needs mitsuba and a libLLVM of version 15 or later: in DRJIT_LIBLLVM_PATH, or that of a Rust
toolchain in ~/.rustup.
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
from made import made
from peers import BARE_EMBREE
from relight_rays import ray_rates
from relight_scenes import TESTS, Scene, mesh_scene, sphere_scene, true_mesh
from torch import Tensor

from lab.record import result_text
from univoxel.camera import image_rays
from univoxel.color import linear_to_srgb, srgb_to_linear
from univoxel.core.records import Mesh
from univoxel.data import load_photos
from univoxel.data.images import read_image
from univoxel.envmap import EnvMap, tables
from univoxel.ops import VisibilityScene, relight

SPP = [1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024]
TRUTH_SPP = 8192
THEIR_TRUTH_SPP = 16384
THEIR_SPP = [16, 64, 256]
COMMON = {"offset": 1e-3, "bounces": 2}


def psnr(a: Tensor, b: Tensor) -> float:
    return float(-10 * torch.log10((a - b).square().mean()))


def timed(work, repeat: int = 3) -> tuple[Tensor, float]:
    """A result and the median time it takes."""
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        result = work()
        times.append(time.perf_counter() - start)
    return result, sorted(times)[repeat // 2]


def strategies(scene: Scene) -> list[dict]:
    """Relative root mean square error and time by strategy and samples per pixel."""
    truth = relight(*scene.ours, samples=TRUTH_SPP, seed=1, **COMMON)
    rows = []
    for name in ("mis", "map", "brdf"):
        for samples in SPP:
            options = COMMON | {"samples": samples, "strategy": name}
            rgb, seconds = timed(lambda o=options: relight(*scene.ours, **o))
            rows.append(
                {"strategy": name, "spp": samples, "error": _error(rgb, truth), "seconds": seconds}
            )
    return rows


def against_mitsuba(scene: Scene, ours: list[dict]) -> dict | None:
    """PSNR between the two at many samples; time of both at equal error. None: it cannot run.

    Once with our BRDF written for Mitsuba, which draws by the cosine, and once with its own
    `principled`, each against its own picture of many samples.
    """
    truth = relight(*scene.ours, samples=TRUTH_SPP, seed=1, **COMMON)
    own = [r for r in ours if r["strategy"] == "mis"]
    times, errors = (np.log([r[key] for r in own]) for key in ("seconds", "error"))
    found = {}
    for principled in (False, True):
        many = _by_mitsuba(scene, THEIR_TRUTH_SPP, principled)
        if many is None:
            return None
        rows = []
        for samples in THEIR_SPP:
            few = _by_mitsuba(scene, samples, principled)
            assert few is not None
            # The noise of their reference adds up to theirs: taken off again.
            error = _error(few[0], many[0]) / math.sqrt(1 + samples / THEIR_TRUTH_SPP)
            equal = float(np.exp(np.interp(-np.log(error), -errors, times)))
            rows.append(
                {
                    "spp": samples,
                    "error": error,
                    "seconds": few[1],
                    "univoxel_seconds": equal,
                    "ratio": few[1] / equal,
                }
            )
            print(rows[-1], flush=True)
        found["principled" if principled else "same_brdf"] = rows
        if not principled:
            pictures = truth.clamp_max(1), many[0].clamp_max(1)
            # Where interpolated normals look away from the eye Mitsuba's picture is black
            facing = (scene.ours[4] * scene.ours[5]).sum(1) > 0
            found["psnr_at_many_samples"] = psnr(*pictures)
            found["psnr_facing"] = psnr(*(p[facing] for p in pictures))
            found["pixels_facing_away"] = int((~facing).sum())
    return found


def _error(rgb: Tensor, truth: Tensor) -> float:
    return float((rgb - truth).square().mean().sqrt() / truth.mean())


def _by_mitsuba(scene: Scene, samples: int, principled: bool) -> tuple[Tensor, float] | None:
    """Mitsuba's radiance along the same rays, and its seconds, compilation left out."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        arrays = {k: np.asarray(v) for k, v in scene.theirs.items()}
        options = {"bounces": COMMON["bounces"], "samples": samples, "principled": principled}
        np.savez(path / "in.npz", **arrays, **options)
        script = TESTS / "mitsuba_reference.py"
        done = subprocess.run(
            [sys.executable, str(script), path / "in.npz", path / "o.npy"],
            capture_output=True,
            text=True,
            check=False,
            env=os.environ | _llvm(),
        )
        if done.returncode:
            print(
                f"no comparison: mitsuba ended with {done.returncode}; it has to be installed, and "
                "DRJIT_LIBLLVM_PATH to name a libLLVM of version 15 or later: "
                f"{done.stderr.strip()[-200:]}",
                file=sys.stderr,
            )
            return None
        return torch.from_numpy(np.load(path / "o.npy")), _seconds(done.stderr)


def _llvm() -> dict[str, str]:
    """Where drjit finds LLVM: as the environment says, else in a Rust toolchain."""
    if "DRJIT_LIBLLVM_PATH" in os.environ:
        return {}
    found = sorted((Path.home() / ".rustup" / "toolchains").glob("stable*/lib/libLLVM.so.*"))
    return {"DRJIT_LIBLLVM_PATH": str(found[-1])} if found else {}


def _seconds(stderr: str) -> float:
    """Time of rendering only, which the script reports after warming up."""
    return float(stderr.rpartition("seconds ")[2].split()[0])


def against_pictures(folder: Path, samples: int, every: int) -> list[dict]:
    """Test views relit from the true surface, against pictures of another renderer.

    The true mesh has no materials: each vertex takes the mean truth of the pixels that see it best,
    vertices that no test view sees those of the nearest that are seen. Pixels are shaded with their
    own truth; at silhouettes by their coverage.
    """
    from scipy.spatial import cKDTree

    photos = load_photos(folder, "test")
    vertices, faces, normals = true_mesh(folder)
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
    mesh = Mesh(vertices, faces, normals, material[:, :3].contiguous(), material[:, 3].contiguous())
    rows = []
    for path in sorted((folder / "envmaps").glob("*.hdr")):
        if not (folder / "relight" / path.stem).is_dir():
            continue
        light = tables(EnvMap(read_image(path)))
        for bounces in (0, 1, 2, 4):
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

    result = json.loads(path.read_text())
    rows, theirs = result["strategies"], result.get("mitsuba")
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True)
    names = {"mis": "both (MIS)", "map": "map alone", "brdf": "BRDF alone"}
    for name, label in names.items():
        own = [r for r in rows if r["strategy"] == name]
        for axis, key in zip(axes, ("spp", "seconds"), strict=True):
            axis.loglog([r[key] for r in own], [r["error"] for r in own], "o-", label=label)
    if theirs:
        for key, label in (("same_brdf", "Mitsuba"), ("principled", "Mitsuba, principled")):
            for axis, x in zip(axes, ("spp", "seconds"), strict=True):
                own = theirs[key]
                axis.loglog([r[x] for r in own], [r["error"] for r in own], "s--", label=label)
    axes[0].set_xlabel("samples per pixel")
    axes[0].set_ylabel("RMS error over mean radiance")
    axes[1].set_xlabel(f"seconds, {result['pixels']} pixels")
    axes[0].legend()
    figure.tight_layout()
    figure.savefig(path.with_suffix(".png"), dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--size", type=int, default=128, help="pixels along the view")
    parser.add_argument("--samples", type=int, default=256, help="per pixel of the pictures")
    parser.add_argument("--every", type=int, default=1, help="take every n-th test view")
    parser.add_argument("--only", default="rays,strategies,mitsuba,pictures")
    arguments = parser.parse_args()
    wanted = arguments.only.split(",")
    if "rays" in wanted and not BARE_EMBREE.exists():
        parser.error(f"rays need {BARE_EMBREE}, which is not there: `make build/.bench` builds it")
    data, size = arguments.data, arguments.size
    result = json.loads(arguments.out.read_text()) if arguments.out.is_file() else {}
    scene = mesh_scene(data, size) if data else sphere_scene(size)
    result |= {
        "threads": torch.get_num_threads(),
        "load": os.getloadavg()[0],
        "scene": data.name if data else "sphere over a plane",
        "triangles": len(scene.ours[1].faces),
        "pixels": len(scene.ours[3]),
    }
    if "rays" in wanted:
        result["rays"] = ray_rates(scene)
        print(result["rays"], flush=True)
    if "strategies" in wanted:
        result["strategies"] = strategies(scene)
    if "mitsuba" in wanted:
        result["mitsuba"] = against_mitsuba(scene, result["strategies"])
    if data and "pictures" in wanted:
        result["pictures"] = against_pictures(data, arguments.samples, arguments.every)
    arguments.out.write_text(result_text(made() | result))
    if "strategies" in result:
        draw(arguments.out)


if __name__ == "__main__":
    main()
