"""What the priors on light do to albedo and relit pictures, charted.

    python benchmarks/priors.py SCENE [SCENE ...] [--lights sg hybrid]

smooth: the weight of the smoothness of the local lobes, on every scene. white: the
weight of the prior for white light, on the first scene as it is and under light of another colour
(its photographs times COLOR; the true albedo stays). Scenes are brought to about --pixels wide.
What differs in a weight alone shares the first stage, which no light takes part in. What is done
already is not done again; the chart is drawn again from all there is.
"""

from __future__ import annotations

import argparse
import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import matplotlib
import numpy as np
import torch
from made import made
from torch import Tensor
from varying import exposed

from lab.record import result_text
from univoxel.cli.evaluate import evaluate
from univoxel.cli.trainer import train
from univoxel.config import LossConfig, TrainConfig, save_config
from univoxel.core.files import replacing
from univoxel.data import load_photos
from univoxel.data.images import read_image, write_png
from univoxel.presets import preset
from univoxel.scene import FILE

matplotlib.use("agg")
import matplotlib.pyplot as plt

SMOOTH = [0.0, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0]
WHITE = [0.0, 0.01, 0.1]
COLOR = torch.tensor([1.35, 1.0, 0.65])  # a lamp beside daylight
MEASURES = {
    "albedo_psnr_3ch": "albedo, a scale per channel",
    "albedo_psnr_1ch": "albedo, one scale",
    "relit_psnr": "relit",
}


def pooled(values: Tensor, by: int) -> Tensor:
    """Means [H, W, C] over squares of `by` pixels."""
    height, width = (n // by for n in values.shape[:2])
    cut = values[: height * by, : width * by].float()
    return cut.reshape(height, by, width, by, -1).mean((1, 3))


def shrunk(folder: Path, by: int, out: Path) -> Path:
    """The data set with pictures 1 / by as wide; normals and depth are left out of its truth."""
    if by == 1 or (out / "meta.json").is_file():
        return folder if by == 1 else out
    ignored = shutil.ignore_patterns("train", "test", "relight", "meta.json")
    shutil.copytree(folder, out, ignore=ignored, dirs_exist_ok=True)
    for path in sorted(folder.glob("**/r_*.png")):
        if path.stem.endswith("_albedo"):
            continue
        rgba = read_image(path)
        alpha = pooled(rgba[..., 3:] / 255, by)
        color = pooled(rgba[..., :3] / 255 * (rgba[..., 3:] > 0), by)
        covered = pooled((rgba[..., 3:] > 0).float(), by).clamp_min(1e-6)
        place = out / path.relative_to(folder)
        place.parent.mkdir(parents=True, exist_ok=True)
        write_png(place, torch.cat([color / covered, alpha], -1))
    (out / "test" / "gt").mkdir()
    for path in sorted((folder / "test" / "gt").glob("*.npz")):
        with np.load(path) as truth:
            alpha = torch.from_numpy(truth["alpha"])[..., None] / 255
            weight = pooled(alpha, by).clamp_min(1e-6)
            small = {"alpha": (255 * pooled(alpha, by)[..., 0]).round().to(torch.uint8).numpy()}
            for key in ("albedo", "roughness"):
                value = torch.from_numpy(truth[key].astype(np.float32)).reshape(
                    *alpha.shape[:2], -1
                )
                mean = (pooled(value * alpha, by) / weight).half().numpy()
                small[key] = mean if key == "albedo" else mean[..., 0]
        np.savez(out / "test" / "gt" / path.name, **small)
    for path in folder.glob("transforms_*.json"):
        root = json.loads(path.read_text())
        for side in {"w", "h"} & root.keys():
            root[side] //= by
        (out / path.name).write_text(json.dumps(root))
    shutil.copy(folder / "meta.json", out / "meta.json")  # last: now it is whole
    return out


def tinted(folder: Path, out: Path) -> Path:
    """The data set with training photographs as under light of another colour."""
    if (out / "meta.json").is_file():
        return out
    photos = load_photos(folder, "train")
    ignored = shutil.ignore_patterns("train", "meta.json")
    shutil.copytree(folder, out, ignore=ignored, dirs_exist_ok=True)
    (out / "train").mkdir()
    color = exposed(photos, (COLOR / COLOR.log().mean().exp()).expand(len(photos), 3))
    for v, name in enumerate(photos.names):
        rgba = torch.cat([color[v], photos.alpha[v][..., None]], -1)
        write_png(out / "train" / f"{name}.png", rgba.numpy())
    shutil.copy(folder / "meta.json", out / "meta.json")
    return out


def trained(cfg: TrainConfig, start: Path) -> None:
    """Train from the first stage that is kept in `start`, and made there if it is not."""
    if (cfg.out / FILE).is_file():
        return
    train(replace(cfg, out=start, stages=cfg.stages[:1]), resume=(start / FILE).is_file())
    partial = cfg.out.with_suffix(".partial")
    shutil.rmtree(partial, ignore_errors=True)
    shutil.copytree(start, partial)
    save_config(replace(cfg, out=partial))
    train(replace(cfg, out=partial), resume=True)
    partial.rename(cfg.out)


def chart(result: dict, path: Path) -> None:
    """A column for each prior, a row for each measure; a line for each scene and light."""
    default = asdict(LossConfig())
    columns: dict[str, dict[str, list[dict]]] = {}  # rows by weight and line
    for name, other in (("light_smoothness", "white_light"), ("white_light", "light_smoothness")):
        lines: dict[str, list[dict]] = {}
        for row in result["runs"].values():
            if row["loss"][other] == default[other]:
                lines.setdefault(f"{row['scene']}, {row['light']}", []).append(row)
        if lines := {line: rows for line, rows in lines.items() if len(rows) > 1}:
            columns[name] = lines
    size = {"figsize": (5 * len(columns), 8), "sharex": "col", "squeeze": False}
    figure, axes = plt.subplots(len(MEASURES), len(columns), **size)
    for axis_row, (measure, title) in zip(axes, MEASURES.items(), strict=True):
        for axis, (name, lines) in zip(axis_row, columns.items(), strict=True):
            for line, rows in sorted(lines.items()):
                points = sorted((row["loss"][name], row[measure]) for row in rows)
                axis.plot(*zip(*points, strict=True), marker="o", label=line)
            axis.set_xscale("symlog", linthresh=0.01)
            axis.axvline(default[name], color="#808080", linestyle=":")
            axis.set_xlabel(f"loss.{name}; dotted: the default")
            axis.set_ylabel(f"{title}, dB")
            axis.spines[["top", "right"]].set_visible(False)
            axis.legend(fontsize=7)
    figure.tight_layout()
    for suffix in (".png", ".svg"):
        figure.savefig(path.with_suffix(suffix), dpi=100)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", type=Path, nargs="*")
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--priors", nargs="+", default=["smooth", "white"])
    parser.add_argument("--lights", nargs="+", default=["sg"], help="which, such as sg hybrid")
    parser.add_argument("--smooth", nargs="+", type=float, default=SMOOTH)
    parser.add_argument("--white", nargs="+", type=float, default=WHITE)
    parser.add_argument("--pixels", type=int, default=100)
    parser.add_argument("--minutes", type=float, default=60.0, help="so many that steps decide")
    parser.add_argument("--work", type=Path, default=Path("build/priors"))
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results/priors.json")
    arguments = parser.parse_args()
    result = json.loads(arguments.out.read_text()) if arguments.out.is_file() else {"runs": {}}
    jobs = []  # scene, folder, light, loss
    default = LossConfig()
    for scene in arguments.scenes:
        wide = load_photos(scene, "test").cameras.width
        small = shrunk(scene, max(1, wide // arguments.pixels), arguments.work / scene.name)
        if "smooth" in arguments.priors:
            losses = [replace(default, light_smoothness=weight) for weight in arguments.smooth]
            jobs += [
                (scene.name, small, light, loss) for light in arguments.lights for loss in losses
            ]
        if "white" in arguments.priors and scene == arguments.scenes[0]:
            other = tinted(small, arguments.work / f"{scene.name}_tinted")
            losses = [replace(default, white_light=weight) for weight in arguments.white]
            for light in arguments.lights:
                for name, folder in ((scene.name, small), (f"{scene.name} tinted", other)):
                    jobs += [(name, folder, light, loss) for loss in losses]
    for scene, folder, light, loss in jobs:
        key = f"{arguments.preset} {scene} {light} smooth {loss.light_smoothness:g}"
        key += f" white {loss.white_light:g}"
        if key in result["runs"]:
            continue
        cfg = preset(arguments.preset, folder, arguments.work / key.replace(" ", "_"), light)
        cfg = replace(cfg, minutes=arguments.minutes, loss=loss)
        first = f"{arguments.preset}_{scene}_{light}_first".replace(" ", "_")
        trained(cfg, arguments.work / first)
        row = {"scene": scene, "light": light, "loss": asdict(loss), "commit": made()["commit"]}
        result["runs"][key] = row | evaluate(cfg.out, samples=16)
        with replacing(arguments.out) as temporary:
            temporary.write_text(result_text(result | made()))
        print(key, {m: round(result["runs"][key][m], 2) for m in MEASURES})
    chart(result, arguments.out)


if __name__ == "__main__":
    main()
