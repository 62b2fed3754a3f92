"""How a training grows: with photographs, their pixels, rays, resolution and ranks.

    python benchmarks/growth.py [--out benchmarks/results/growth.json] [--work DIR] [--only AXIS]

Photographs of a ball, all the same picture: what they show does not matter here. Every case is a
process of its own that prepares, makes a few steps on a small grid and then those that are
measured. Cases that are done are not made again. Seconds are those of the processor, of one thread
in each rank, so that other programs hardly disturb them; of ranks there are seconds by the wall
too. Exponents are slopes of log cost over log size. What they cost to exchange is measured between
two ranks on this machine; `model` says what that makes of more nodes.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np
from made import made
from PIL import Image

from lab.record import result_text

HERE = Path(__file__).parent
STEPS = 16  # that are measured, of which the first are left out
WARM = 4
USUAL = {"photographs": 20, "megapixels": 0.1, "rays": 2048, "resolution": 96, "ranks": 1}
AXES: dict[str, tuple[float, ...]] = {
    "photographs": (20, 100, 400),
    "megapixels": (0.1, 0.4, 1.6, 12),
    "rays": (256, 512, 1024, 2048, 4096),
    "resolution": (64, 96, 128, 256, 512),
    "ranks": (1, 2),
}
NODES = (1, 2, 4, 8, 16, 32, 64)
BANDWIDTH = 10e9 / 8  # bytes a second, of a node
LATENCY = 1e-4  # seconds, of a message between nodes, as TCP takes


def write_ball(folder: Path, count: int, megapixels: float) -> None:
    """So many photographs of a ball from all around, links to one file."""
    if (folder / "transforms_train.json").exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    width, height = (round(math.sqrt(1e6 * megapixels * r)) for r in (4 / 3, 3 / 4))
    radius, focal = 0.4 * height, 1.2 * width
    y, x = np.mgrid[0:height, 0:width].astype(np.float32) + 0.5
    away = np.hypot(x - width / 2, y - height / 2)
    alpha = (255 * (radius + 0.5 - away).clip(0, 1)).astype(np.uint8)
    grey = 20 + 200 * np.sqrt((1 - (away / radius) ** 2).clip(0, 1))
    picture = np.stack([grey, 0.7 * grey, 0.5 * grey], -1).astype(np.uint8)
    first = folder / "p0000.png"
    Image.fromarray(np.dstack([picture, alpha])).save(first, compress_level=1)
    distance, frames = math.sqrt(1 + (focal / radius) ** 2), []
    for i in range(count):
        z, turn = 0.9 * (1 - (2 * i + 1) / count), i * math.pi * (3 - math.sqrt(5))
        flat = math.sqrt(1 - z * z)
        away_from = np.array([flat * math.cos(turn), flat * math.sin(turn), z])
        right = np.cross([0, 0, 1], away_from)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(away_from, right), away_from, distance * away_from], 1)
        if i:
            os.link(first, folder / f"p{i:04d}.png")
        frames.append({"file_path": f"./p{i:04d}", "transform_matrix": pose.tolist()})
    about = {"camera_angle_x": 2 * math.atan(width / 2 / focal), "frames": frames}
    (folder / "transforms_train.json").write_text(json.dumps(about))


def case(scene: Path, run: Path, rays: int, resolution: int) -> dict[str, float]:
    """One training, in this process or in this rank: what it took."""
    from univoxel import ranks
    from univoxel.machine import peak_memory_mb
    from univoxel.optim import rows_of
    from univoxel.presets import preset, with_field
    from univoxel.tasks import train as task
    from univoxel.training import exchange, loop

    cfg = with_field(preset("draft", scene, run), "sparse")
    coarse, fine = cfg.stages[0], cfg.stages[1]
    coarse = replace(coarse, voxels=0.1, iterations=8, rays=512)
    # A box about the ball, that many nodes wide; bricks about its surface
    fine = replace(fine, voxels=resolution**3 / 1e6, iterations=STEPS, rays=rays)
    cfg = replace(
        cfg, stages=(coarse, fine), minutes=600, capacity="fixed", voxel_pixels=0.0, hollows=0.0
    )
    cfg = replace(cfg, light_frame="world", exposures=False)
    steps: list[tuple[float, float]] = []
    touched: list[int] = []
    sent: list[int] = []
    summed = loop.summed_over_ranks_

    def noted(parameters, terms):
        result = summed(parameters, terms)
        steps.append((time.process_time(), time.monotonic()))
        sent.append(exchange.TRAFFIC.sent)
        grads = [p.grad for p in parameters if p.grad is not None]
        sparse = [g for g in grads if g.is_sparse]
        touched.append(
            sum(4 * g._values().numel() + 4 * len(rows_of(g)) for g in sparse)
            + sum(4 * g.numel() for g in grads if not g.is_sparse)
        )
        return result

    loop.summed_over_ranks_ = noted
    begin, prepared = time.process_time(), []
    run_stage = task.run_stage

    def first_stage(*arguments):
        prepared.append(time.process_time() - begin)
        run_stage(*arguments)

    task.run_stage = first_stage
    task.save_trust = lambda *_: None
    task.train(cfg)
    last = steps[-(STEPS - WARM) :]
    each = [(b[0] - a[0], b[1] - a[1]) for a, b in itertools.pairwise(last)]
    return {
        "preparation": prepared[0],
        "step": median(c for c, _ in each),
        "wall": median(w for _, w in each),
        "touched": median(touched[-(STEPS - WARM) :]),
        "sent": median(b - a for a, b in itertools.pairwise(sent[-(STEPS - WARM) :])),
        "peak_mb": peak_memory_mb() or 0.0,
        "rank": int(os.environ.get("RANK", "0")),
        "ranks": ranks.count(),
    }


def measured(size: dict[str, float], work: Path) -> dict[str, float]:
    """A case in a process, or processes, of its own."""
    scene = work / f"ball_{size['photographs']:g}_{size['megapixels']:g}"
    write_ball(scene, int(size["photographs"]), size["megapixels"])
    run = work / "run"
    subprocess.run(["rm", "-rf", str(run)], check=True)
    command = [sys.executable]
    if size["ranks"] > 1:
        command += ["-m", "torch.distributed.run", "--standalone"]
        command += ["--nproc-per-node", f"{size['ranks']:g}"]
    told = work / "told.json"
    command += [str(Path(__file__)), "--case", str(scene), str(run), str(told)]
    command += [f"{size['rays']:g}", f"{size['resolution']:g}"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL)
    return json.loads(told.read_text())


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Slope of log cost over log size."""
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def model(cases: dict[str, dict[str, dict[str, float]]]) -> dict[str, object]:
    """What a step takes on more nodes, from what one node and two ranks showed.

        seconds(n) = fixed + per_ray R / n + moved(n) / bandwidth + latency (n - 1)
        moved(n) = (n - 1) touched(R / n)

    Every node does the same to all touched rows, and its share of R rays; of the rows that the
    others have touched it gets all. Fixed and per_ray are a line through the steps of 1 to R rays,
    touched a power of rays.
    """
    by_rays = {float(k): v for k, v in cases["rays"].items()}
    rays = list(by_rays)
    per_ray, fixed = np.polyfit(rays, [by_rays[r]["step"] for r in rays], 1)
    touched = [by_rays[r]["touched"] for r in rays]
    power = exponent(rays, touched)
    factor = math.exp(float(np.mean(np.log(touched) - power * np.log(rays))))

    def seconds(n: int, all_rays: float) -> tuple[float, float]:
        moved = (n - 1) * factor * (all_rays / n) ** power
        return fixed + per_ray * all_rays / n, moved / BANDWIDTH + LATENCY * (n - 1)

    usual = USUAL["rays"]
    rows = []
    for n in NODES:
        shared, grown = seconds(n, usual), seconds(n, usual * n)
        rows.append(
            {
                "nodes": n,
                "work_ms": 1e3 * shared[0],
                "exchange_ms": 1e3 * shared[1],
                "faster": sum(seconds(1, usual)) / sum(shared),
                "rays_faster": n * sum(seconds(1, usual)) / sum(grown),
            }
        )
    return {
        "fixed_ms": 1e3 * float(fixed),
        "ray_us": 1e6 * float(per_ray),
        "touched_power": power,
        "touched_bytes": factor * usual**power,
        "nodes": rows,
    }


def exponents(cases: dict[str, dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """By axis and by what grows."""
    found = {}
    for axis in ("photographs", "megapixels", "rays", "resolution"):
        sizes = [float(k) for k in cases[axis]]
        of_axis = list(cases[axis].values())
        found[axis] = {
            what: exponent(sizes, [c[what] for c in of_axis])
            for what in ("preparation", "step", "peak_mb")
        }
    return found


def main() -> None:
    if "--case" in sys.argv:
        at = sys.argv.index("--case")
        scene, run, told, rays, resolution = sys.argv[at + 1 :]
        found = case(Path(scene), Path(run), int(rays), int(resolution))
        if found["rank"] == 0:
            Path(told).write_text(json.dumps(found))
        return
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=HERE / "results" / "growth.json")
    parser.add_argument("--work", type=Path, default=Path("growth"))
    parser.add_argument("--only", choices=tuple(AXES))
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    kept = options.work / "cases.json"  # what is done; the same command goes on from there
    cases = json.loads(kept.read_text()) if kept.exists() else {}
    for axis, sizes in AXES.items():
        if options.only not in (None, axis):
            continue
        for size in sizes:
            of_axis = cases.setdefault(axis, {})
            if f"{size:g}" not in of_axis:
                done = [cases.get(other, {}).get(f"{USUAL[other]:g}") for other in AXES]
                usual = next(filter(None, done), None) if size == USUAL[axis] else None
                found = usual or measured(USUAL | {axis: size}, options.work)
                of_axis[f"{size:g}"] = found
                kept.write_text(json.dumps(cases))
            print(axis, f"{size:g}", json.dumps(of_axis[f"{size:g}"]), flush=True)
    if options.only is None:
        result = made() | {"cases": cases, "exponents": exponents(cases), "model": model(cases)}
        options.out.write_text(result_text(result))


if __name__ == "__main__":
    main()
