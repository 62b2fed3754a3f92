"""Quality against the size of the model and training time: kinds of fields, and fixed sizes.

    python benchmarks/capacity.py DATA ... [--preset draft] [--settings dense sparse hash adaptive]

Trains and evaluates every DATA with every setting, all steps, relit with 16 samples; what is done
already is not done again. `ball` for DATA makes the scene of ball.py. A setting is `dense`,
`sparse` or `hash`, the preset's sizes on such a field; `adaptive`, its sizes as limits;
`budget-X`, adaptive in X million bytes; `voxels-X`, dense with X million voxels in the fine stages;
`channels-N`, dense with N feature channels, half of them of material. Parameters are counted as
`univoxel info` does, in the model's file. Writes results/capacity.json, .png and .svg.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

from ball import write
from made import made

from lab import plots
from lab.record import result_text
from univoxel.cli.evaluate import evaluate
from univoxel.cli.info import info
from univoxel.cli.trainer import train
from univoxel.config import StageConfig, TrainConfig
from univoxel.core.files import replacing
from univoxel.presets import preset, with_field
from univoxel.scene import FILE

SETTINGS = ["dense", "sparse", "hash", "adaptive"]
PANELS = [plots.NVS, plots.ALBEDO, plots.RELIT]
ACROSS = [("stored_parameters", "parameters in the model's file"), ("train_seconds", "training, s")]


def configured(base: TrainConfig, setting: str) -> TrainConfig:
    """The configuration of a setting, on the fields of `base` where it names no others.

    Raises:
        ValueError: no such setting.
    """
    kind, _, value = setting.partition("-")
    match kind:
        case "dense" | "sparse" | "hash":
            return with_field(base, kind)
        case "voxels":
            base = with_field(base, "dense")
            first, *rest = base.stages
            fewer = [
                replace(s, voxels=float(value)) if isinstance(s, StageConfig) else s for s in rest
            ]
            return replace(base, stages=(first, *fewer))
        case "channels":
            base = with_field(base, "dense")
            count = int(value)
            return replace(
                base, scene=replace(base.scene, channels=count, material_channels=count // 2)
            )
        case "adaptive" | "budget":
            return replace(base, capacity="adaptive", budget_mb=float(value) if value else None)
    raise ValueError(f"no such setting: {setting}")


def draw(runs: dict[str, dict], stem: Path) -> None:
    """Write the chart: a column for each measure, a row for size and one for time; a line joins
    the settings of a scene."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

    scenes = list(dict.fromkeys(name.split()[0] for name in runs))
    settings = list(dict.fromkeys(name.split()[-1] for name in runs))
    figure = Figure(figsize=(4 * len(PANELS), 7), layout="constrained")
    grid = figure.subplots(len(ACROSS), len(PANELS), squeeze=False)
    for row, (key, label) in zip(grid, ACROSS, strict=True):
        for axes, measure in zip(row, PANELS, strict=True):
            for mark, scene in zip("osD^vP*", scenes, strict=False):
                own = {n.split()[-1]: r for n, r in runs.items() if n.split()[0] == scene}
                own = {n: r for n, r in own.items() if {key, measure.key} <= r.keys()}
                points = sorted((r[key], r[measure.key]) for r in own.values())
                axes.plot([x for x, _ in points], [y for _, y in points], color="0.8", zorder=1)
                for name, r in own.items():
                    number = settings.index(name)
                    axes.scatter(r[key], r[measure.key], color=plots.color(number), marker=mark)
            axes.set(xscale="log", xlabel=label, title=measure.title)
            axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.xaxis.set_minor_formatter(NullFormatter())
            axes.grid(alpha=0.3)
    first = grid[0][0]
    for k, name in enumerate(settings):
        first.scatter([], [], color=plots.color(k), label=name)
    for mark, scene in zip("osD^vP*", scenes, strict=False):
        first.scatter([], [], color="0.5", marker=mark, label=scene)
    first.legend(fontsize=7)
    plots.save_figure(figure, stem)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("data", nargs="+", type=Path)
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--settings", nargs="+", default=SETTINGS)
    parser.add_argument("--minutes", type=float, default=9999.0, help="so many that steps decide")
    parser.add_argument("--work", type=Path, default=Path("build/capacity"))
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results/capacity.json")
    arguments = parser.parse_args()
    plots.require()
    result = json.loads(arguments.out.read_text()) if arguments.out.is_file() else {"runs": {}}
    for data in arguments.data:
        source = write(arguments.work / "data/ball") if str(data) == "ball" else data
        for setting in arguments.settings:
            name = f"{data.name} {arguments.preset} {setting}"
            if name in result["runs"]:
                continue
            run = arguments.work / name.replace(" ", "_")
            base = replace(preset(arguments.preset, source, run), capacity="fixed")
            cfg = replace(configured(base, setting), minutes=arguments.minutes)
            train(cfg, resume=(run / FILE).is_file())
            found = info(run)
            own = evaluate(run, samples=16) | {
                "stored_parameters": found["parameters"],
                "bytes": found["bytes"],
                "chosen": [c["said"] for c in found["chosen"]],
            }
            result["runs"][name] = own | {"commit": made()["commit"]}
            with replacing(arguments.out) as temporary:
                temporary.write_text(result_text(result | made()))
    draw(result["runs"], arguments.out.with_suffix(""))


if __name__ == "__main__":
    main()
