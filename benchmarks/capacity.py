"""Quality against the size of the model: fixed sizes, and what adapting them makes of the scene.

    python benchmarks/capacity.py DATA [--preset draft] [--settings fixed voxels-0.25 adaptive ...]

Trains and evaluates DATA with every setting, all steps, relit with 16 samples; what is done
already is not done again. A setting is `fixed`, the preset as it is; `voxels-X`, X million voxels
in its fine stages; `channels-N`, N feature channels, half of them of material; `adaptive`; or
`budget-X`, adaptive in X million bytes. Parameters are counted as `univoxel info` does, in the
model's file. Writes results/capacity.json, .png and .svg; the result names the command.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

from univoxel.config import StageConfig, TrainConfig, preset
from univoxel.data.images import replacing
from univoxel.experiments import plots
from univoxel.scene import FILE
from univoxel.tasks.evaluate import evaluate
from univoxel.tasks.info import info
from univoxel.tasks.train import train

SETTINGS = ["fixed", "voxels-0.5", "voxels-0.25", "voxels-0.125", "channels-8", "adaptive"]
PANELS = [plots.NVS, plots.ALBEDO, plots.RELIT, plots.NORMAL]


def configured(base: TrainConfig, setting: str) -> TrainConfig:
    """The configuration of a setting.

    Raises:
        ValueError: no such setting.
    """
    kind, _, value = setting.partition("-")
    match kind:
        case "fixed":
            return base
        case "voxels":
            first, *rest = base.stages
            fewer = [
                replace(s, voxels=float(value)) if isinstance(s, StageConfig) else s for s in rest
            ]
            return replace(base, stages=(first, *fewer))
        case "channels":
            count = int(value)
            return replace(
                base, scene=replace(base.scene, channels=count, material_channels=count // 2)
            )
        case "adaptive" | "budget":
            return replace(base, capacity="adaptive", budget_mb=float(value) if value else None)
    raise ValueError(f"no such setting: {setting}")


def draw(runs: dict[str, dict], stem: Path) -> None:
    """Write the chart: a panel for each measure, parameters across."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter, NullFormatter

    figure = Figure(figsize=(3.6 * len(PANELS), 3.6), layout="constrained")
    for axes, measure in zip(figure.subplots(1, len(PANELS)), PANELS, strict=True):
        for k, (name, own) in enumerate(runs.items()):
            adapted = name.split()[-1].startswith(("adaptive", "budget"))
            x, y = own["stored_parameters"], own[measure.key]
            axes.scatter(x, y, color=plots.color(1 if adapted else 0), zorder=2)
            axes.annotate(
                name.split()[-1],
                (x, y),
                xytext=(4, 4 - 12 * (k % 2)),
                textcoords="offset points",
                fontsize=7,
            )
        axes.set(xscale="log", xlabel="parameters in the model's file", title=measure.title)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.margins(x=0.25, y=0.1)
        axes.grid(alpha=0.3)
        if not measure.more:
            axes.invert_yaxis()
    plots.save_figure(figure, stem)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("data", type=Path)
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--settings", nargs="+", default=SETTINGS)
    parser.add_argument("--minutes", type=float, default=9999.0, help="so many that steps decide")
    parser.add_argument("--work", type=Path, default=Path("build/capacity"))
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results/capacity.json")
    arguments = parser.parse_args()
    plots.require()
    result = json.loads(arguments.out.read_text()) if arguments.out.is_file() else {"runs": {}}
    result["command"] = " ".join(["python", *sys.argv])
    for setting in arguments.settings:
        name = f"{arguments.data.name} {arguments.preset} {setting}"
        if name in result["runs"]:
            continue
        run = arguments.work / name.replace(" ", "_")
        base = replace(preset(arguments.preset, arguments.data, run), capacity="fixed")
        cfg = replace(configured(base, setting), minutes=arguments.minutes)
        train(cfg, resume=(run / FILE).is_file())
        found = info(run)
        own = evaluate(run, samples=16) | {
            "stored_parameters": found["parameters"],
            "chosen": [c["said"] for c in found["chosen"]],
        }
        result["runs"][name] = own
        with replacing(arguments.out) as temporary:
            temporary.write_text(json.dumps(result, indent=1) + "\n")
    draw(result["runs"], arguments.out.with_suffix(""))


if __name__ == "__main__":
    main()
