"""What a run's log, state and configuration tell of its training."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from univoxel.config import TrainConfig, load_config
from univoxel.errors import UserError
from univoxel.pictures.charts import Curve
from univoxel.training.clock import ALL, Clock, stage_name
from univoxel.training.progress import LOG

log: logging.Logger = logging.getLogger("univoxel")


@dataclass(frozen=True)
class StageFacts:
    """A stage of a training, for people."""

    name: str
    planned: int  # steps
    made: float | None  # share of them; None: it has not ended
    seconds: float | None  # None: not known
    fate: str  # what ended it


def curves(run: Path) -> list[Curve]:
    """Loss and held-out quality over time; empty where the log cannot be read."""
    losses: list[list[tuple[float, float]]] = []
    qualities: list[list[tuple[float, float]]] = []
    stage, resumed = None, 0.0
    try:
        for text in (run / LOG).read_text(encoding="utf-8").splitlines():
            line = json.loads(text)
            seconds = float(line["seconds"])
            if line["stage"] != stage or seconds < resumed:  # or a sitting that began again
                stage = line["stage"]
                losses.append([])
                qualities.append([])
            resumed = seconds
            if line["losses"]:
                losses[-1].append((seconds, float(sum(line["losses"].values()))))
            if line["held_out_psnr"] is not None:
                qualities[-1].append((seconds, float(line["held_out_psnr"])))
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        log.info("no curves: %s cannot be read: %s", run / LOG, error)
        return []
    found = (
        Curve("loss: the sum of what is minimised", losses, logarithmic=True),
        Curve("validation, PSNR in dB", qualities),
    )
    return [curve for curve in found if any(curve.pieces)]


def configuration(run: Path) -> TrainConfig | None:
    """What the run was trained with; None where its config.json cannot be read."""
    try:
        return load_config(run / "config.json")
    except (UserError, OSError) as error:
        log.info("stages are not told: %s", error)
        return None


def stages(cfg: TrainConfig, state: dict[str, Any]) -> list[StageFacts]:
    """The stages of a training, in order."""
    made, early, took = (list(state.get(key, ())) for key in ("made", "early", "took"))
    found = []
    for k, stage in enumerate(cfg.stages):
        share = made[k] if k < len(made) else None
        if share is None:
            fate = "not begun" if k > len(made) or not state.get("progress") else "not ended"
        elif k in early:
            fate = "ended early: nothing was left to gain"
        elif share < ALL:
            fate = "stopped early" if state.get("finished") else "cut by the time limit"
        else:
            fate = "whole"
        seconds = took[k] if k < len(took) else None
        found.append(StageFacts(stage_name(cfg.stages, k), stage.iterations, share, seconds, fate))
    return found


def ends(state: dict[str, Any]) -> list[float]:
    """Seconds at which stages ended, the last first counted from the end of training; empty where
    that was not kept."""
    took = list(state.get("took", ()))
    if not took or "seconds" not in state:
        return []
    begin = state["seconds"] - sum(took) - state.get("stage_took", 0.0)  # preparation
    return [begin + sum(took[: k + 1]) for k in range(len(took) - 1)]


def prepared(state: dict[str, Any]) -> float | None:
    """Seconds of training that passed outside of stages: what was done before the first."""
    took = list(state.get("took", ()))
    if not took or "seconds" not in state:
        return None
    return max(state["seconds"] - sum(took) - state.get("stage_took", 0.0), 0.0)


def remarks(cfg: TrainConfig, state: dict[str, Any]) -> list[str]:
    """What time cut, what went wrong, what was chosen; sentences."""
    told = []
    if state.get("stage", 0) < len(cfg.stages):
        told.append(f"Training has not ended: it stands in stage {state.get('stage', 0) + 1}.")
    if cut := Clock(cfg, 0.0, state).cut():
        told.append(cut[0].upper() + cut[1:] + ".")
    troubles: Sequence[str] = state.get("troubles", ())
    if troubles:
        told.append(f"Training met trouble {len(troubles)} times, the last in {troubles[-1]}.")
    chosen = [entry.get("said", "") for entry in state.get("chosen", ())]
    return told + [f"Size chosen: {said}." for said in chosen if said]
