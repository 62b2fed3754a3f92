"""Whether the photographs that a report asks for are worth more than as many others.

    python benchmarks/advice.py DATA WORK [--sector 90] [--width 90] [--more 4] [--preset draft]

DATA is a scene in NeRF layout with test views. A sector of its photographs is kept back, and as
many others as are added, spread over the rest. It is trained without them, and with as many more:
of those kept back the nearest to the advised directions, or the others. Prints, for each, the mean
expected error of the albedo and the measures of the test views. What is done already in WORK is not
done again.
"""

from __future__ import annotations

import argparse
import json
import shutil
from dataclasses import replace
from pathlib import Path

import torch
from torch.nn.functional import normalize

from univoxel.camera import looked_at
from univoxel.cli.evaluate import evaluate
from univoxel.cli.trainer import train
from univoxel.core.files import replacing
from univoxel.data import Photos, load_photos
from univoxel.evaluation.confidence import ADVICE, POINTS, Advice, Survey, advise, azimuths, survey
from univoxel.presets import preset
from univoxel.run import photos_of
from univoxel.scene import FILE, load_scene

FRAMES = "transforms_train.json"
MINUTES = 60.0  # no limit: presets are compared, and not the machine's load
SHOWN = ("nvs_psnr", "albedo_psnr_3ch", "relit_psnr", "normal_mae_deg", "chamfer")


def directions_of(photos: Photos) -> torch.Tensor:
    """Unit vectors [V, 3] from what the cameras look at to where they stand."""
    cameras = photos.cameras
    return normalize(cameras.camera_to_world[:, :, 3] - looked_at(cameras), dim=1)


def in_sector(direction: torch.Tensor, azimuth: float, width: float) -> torch.Tensor:
    """Which directions [N, 3] have azimuths within half the width, in degrees: [N]."""
    return ((azimuths(direction) - azimuth + 180) % 360 - 180).abs() <= width / 2


def subset(data: Path, folder: Path, names: set[str]) -> Path:
    """The scene with some of its photographs."""
    if not folder.exists():
        shutil.copytree(data, folder)
        described = json.loads((data / FRAMES).read_text(encoding="utf-8"))
        frames = described["frames"]
        described["frames"] = [f for f in frames if Path(f["file_path"]).name in names]
        with replacing(folder / FRAMES) as temporary:
            temporary.write_text(json.dumps(described), encoding="utf-8")
    return folder


def trained(data: Path, run: Path, name: str, seed: int) -> Path:
    if not (run / "trust.txt").exists():  # written last
        config = preset(name, data, run)
        train(replace(config, minutes=MINUTES, seed=seed), resume=(run / FILE).exists())
    return run


def looked_through(run: Path, most: int) -> tuple[Survey, Advice]:
    """What the photographs of a run fix, and what to photograph next."""
    scene = load_scene(run)
    photos = photos_of(run, split="train")
    found = survey(scene, photos, POINTS)
    asked = replace(ADVICE, most=most, least=0.0, share=0.0)
    cameras = scene.registered(photos).cameras
    return found, advise(found, cameras, photos.names, scene.occluder(), asked)


def nearest(photos: Photos, pool: list[int], advice: Advice) -> list[int]:
    """Photographs of the pool, another one for each advised direction."""
    away, taken = directions_of(photos), []
    for direction in advice.chosen:
        taken.append(max((i for i in pool if i not in taken), key=lambda i: away[i] @ direction))
    return taken


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--sector", type=float, default=90.0, help="azimuth of its middle")
    parser.add_argument("--width", type=float, default=90.0)
    parser.add_argument("--more", type=int, default=4)
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    photos = load_photos(asked.data, "train")
    sector = in_sector(directions_of(photos), asked.sector, asked.width)
    rest = (~sector).nonzero()[:, 0]
    order = rest[torch.randperm(len(rest), generator=torch.Generator().manual_seed(asked.seed))]
    others, before = order[: asked.more].tolist(), order[asked.more :].tolist()

    def result(name: str, kept: list[int]) -> tuple[dict[str, float], Advice]:
        data = subset(asked.data, asked.work / f"{name}-data", {photos.names[i] for i in kept})
        run = trained(data, asked.work / name, asked.preset, asked.seed)
        surveyed, advice = looked_through(run, asked.more)
        measured = evaluate(run, samples=16)
        seen = surveyed.seen_with(surveyed.straight)
        figures = {"error": float(surveyed.errors[:, 0].mean()), "seen": float(seen.mean())}
        return figures | {key: measured[key] for key in SHOWN}, advice

    print(f"{int(sector.sum())} photographs in the sector, {len(before)} before")
    first, advice = result("before", before)
    pool = [*sector.nonzero()[:, 0].tolist(), *others]
    added = nearest(photos, pool, advice)
    inside = in_sector(advice.chosen, asked.sector, asked.width)
    print(f"advised: {azimuths(advice.chosen).round().tolist()} of which in it {inside.tolist()}")
    print(f"gains: {[round(g, 4) for g in advice.gains.tolist()]}")
    print(f"added: {[photos.names[i] for i in added]}, in it {sector[added].tolist()}")
    rows = {"before": first}
    rows["advised"], after = result("advised", before + added)
    print(f"gains after: {[round(g, 4) for g in after.gains.tolist()]}")
    rows["others"], _ = result("others", before + others)
    for name, row in rows.items():
        print(f"{name:8}", " ".join(f"{key} {value:.4g}" for key, value in row.items()))


if __name__ == "__main__":
    main()
