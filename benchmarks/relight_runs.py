"""Relit PSNR of trained runs by bounces and by exponent of the roughness; frame time and noise.

python benchmarks/relight_runs.py OUT.json RUN [RUN ...] [--every N]

PSNR is relit_psnr of `univoxel eval`: test views under the data set's other maps, the albedo times
a scale per channel. The time of a frame is that of the pixels' light only; its error is the root
mean square over the object, in steps of 1 / 255 of sRGB, against 4096 samples.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import torch
from made import made

from lab.record import result_text
from univoxel.color import linear_to_srgb
from univoxel.core.records import Surface
from univoxel.data import load_photos, load_relit, relight_maps
from univoxel.data.photos import decode
from univoxel.envmap import read_map, tables
from univoxel.evaluation.measures import albedo_scales
from univoxel.render.metrics import on_black, psnr
from univoxel.render.pipeline import extract_mesh, surface_of_view
from univoxel.render.relight import Lighting, TracedMesh, relight_surface, traced_mesh
from univoxel.run import trained_on
from univoxel.scene import load_scene

BOUNCES = [0, 1, 2, 4]
EXPONENTS = [1.0, 1.5]
SPP = [16, 32, 64, 128, 256]
TRUTH_SPP = 4096


def _scaled(what, scale):
    return replace(what, albedo=(what.albedo * scale).clamp_max(1))


def _rougher(what, exponent):
    return replace(what, roughness=what.roughness**exponent)


def scores(run: Path, every: int, samples: int = 64) -> list[dict]:
    """relit_psnr of a run by bounces and exponent."""
    scene, folder = load_scene(run), trained_on(run)
    photos = load_photos(folder, "test")
    scale = albedo_scales(scene, photos).three
    here = traced_mesh(_scaled(extract_mesh(scene), scale), scene.field.voxel_size)
    maps = relight_maps(folder)
    lights = {name: Lighting(tables(read_map(path))) for name, path in maps.items()}
    wanted = {name: load_relit(photos, name) for name in lights}
    found: dict[tuple[int, float], list[float]] = {}
    for view in range(0, len(photos), every):
        surface, wo = surface_of_view(scene, photos.cameras, view)
        surface = _scaled(surface, scale)
        for exponent in EXPONENTS:
            rough, its_stage = (
                _rougher(surface, exponent),
                replace(here, mesh=_rougher(here.mesh, exponent)),
            )
            for bounces in BOUNCES:
                for name, light in lights.items():
                    options = {"samples": samples, "bounces": bounces}
                    rgb = relight_surface(rough, wo, its_stage, light, **options)
                    color, alpha = (part[view] for part in wanted[name])
                    picture = on_black(*decode(color, alpha))
                    made = linear_to_srgb(rgb * surface.opacity[:, None]).view_as(picture)
                    found.setdefault((bounces, exponent), []).append(psnr(made, picture))
    return [
        {"run": run.name, "bounces": b, "exponent": e, "relit_psnr": fmean(values)}
        for (b, e), values in found.items()
    ]


def noise(surface: Surface, wo: torch.Tensor, here: TracedMesh, light: Lighting) -> list[dict]:
    """Seconds and error of one frame by samples per pixel, with two bounces."""

    def picture(samples: int, seed: int) -> torch.Tensor:
        options = {"samples": samples, "bounces": 2, "seed": seed}
        rgb = relight_surface(surface, wo, here, light, **options)
        return linear_to_srgb(rgb * surface.opacity[:, None])[surface.opacity > 0]

    truth, rows = picture(TRUTH_SPP, 1), []
    for samples in SPP:
        times = []
        for _ in range(3):
            start = time.perf_counter()
            made = picture(samples, 0)
            times.append(time.perf_counter() - start)
        error = float((made - truth).square().mean().sqrt())
        rows.append({"spp": samples, "seconds": sorted(times)[1], "error_255": 255 * error})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--every", type=int, default=1, help="take every n-th test view")
    parser.add_argument("--only", default="scores,noise")
    arguments = parser.parse_args()
    result = json.loads(arguments.out.read_text()) if arguments.out.is_file() else {}
    result["threads"] = torch.get_num_threads()
    for run in arguments.runs:
        own = result.setdefault(trained_on(run).name, {})
        if "scores" in arguments.only:
            own["scores"] = scores(run, arguments.every)
        if "noise" in arguments.only:
            scene, folder = load_scene(run), trained_on(run)
            cameras = load_photos(folder, "test").cameras
            start = time.perf_counter()
            surface, wo = surface_of_view(scene, cameras, 0)
            own["surface_seconds"] = time.perf_counter() - start
            own["size"] = [cameras.width, cameras.height]
            own["pixels"] = int((surface.opacity > 0).sum())
            here = traced_mesh(extract_mesh(scene), scene.field.voxel_size)
            own["triangles"] = len(here.mesh.faces)
            own["noise"] = {
                name: noise(surface, wo, here, Lighting(tables(read_map(path))))
                for name, path in relight_maps(folder).items()
            }
        print(run.name, json.dumps(own, indent=1), flush=True)
        arguments.out.write_text(result_text(result | made()))


if __name__ == "__main__":
    main()
