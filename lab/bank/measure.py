"""What a training decided about a scene of the bank, and how well it knew its own errors."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lab.bank.scenes import HALVES, MIRROR, TRUTH
from lab.record import Outcome
from univoxel.core.files import read_json
from univoxel.data import load_photos
from univoxel.evaluation.confidence import QUANTITIES, ExpectedErrors
from univoxel.evaluation.measures import (
    albedo_scales,
    errors_of,
    expected_view,
    render_layers,
    survey_of,
)
from univoxel.render.pipeline import surface_of_view
from univoxel.scene import Scene, load_checkpoint

MEASURES = {
    "nvs_psnr": ("novel views, dB", 2),
    "albedo_psnr_fg": ("albedo in the mask, dB", 2),
    "albedo_psnr_3ch": ("albedo, whole image, dB", 2),
    "roughness_mse": ("roughness MSE", 4),
    "relit_psnr": ("relit, dB", 2),
    "normal_mae_deg": ("normals, degrees", 2),
}
RANKS = {
    "trust_spearman": "albedo",
    "trust_spearman_roughness": "roughness",
    "trust_spearman_normal": "normal",
}
# A scene's decisions that are yes or no, by key
DECISIONS = {
    "all_metal": "all is metal",
    "mirrors": "something is a mirror",
    "exposures": "exposures differ",
    "light": "light varies",
    "turntable": "light turns with the camera",
    "flash": "a flash",
}
SHARES = {"false_metal": "taken for metal", "false_mirror": "taken for a mirror"}
MATTE = 0.4  # roughness from which a surface without metal is matte
LEAST = 0.01  # share of the object's pixels below which a piece of it is not asked about
ALL, SOME = 0.95, 0.03  # shares from which all is metal, and something is a mirror
# Bounds of the bins of expected errors, each a constant times the one before
BOUNDS = {"albedo": (0.02, 0.2), "roughness": (0.05, 0.5), "normal": (1.5, 30.0)}
BINS = 10


@torch.no_grad()
def judged(run: Path, data: Path) -> dict[str, Any]:
    """Decisions and calibration of a run on a scene of the bank, as JSON.

    A decision that is yes or no is [truth, found]; a pair of numbers under "metal" is how many
    pieces were told right, of how many. A piece is what of one part is metal, or is not.
    """
    truth = read_json(data / TRUTH)
    scene, _ = load_checkpoint(run)
    photos = load_photos(data, "test")
    scales, surveyed = albedo_scales(scene, photos), survey_of(scene, run, None)
    errors = ExpectedErrors(surveyed) if surveyed else None
    layers, pairs = [], {name: [] for name in QUANTITIES}
    for view in range(len(photos)):
        shown = render_layers(scene, photos.cameras, view, None, errors)
        found = errors_of(shown, expected_view(photos, {}, view), scales)
        for key, pair in found.items():
            pairs[key] += [] if pair is None else [pair]
        surface, _ = surface_of_view(scene, photos.cameras, view)
        path = data / "test" / "gt" / f"{photos.names[view]}.npz"
        layers.append(materials_of(path, surface.metallic, surface.roughness))
    metal, true_metal, roughness, true_roughness, part = np.concatenate(layers, 1)
    right, asked = pieces(metal, true_metal, part)
    matte = (true_metal < 0.1) & (true_roughness > MATTE)
    return {
        "half": truth["drawn"]["half"],
        "metal": [right, asked],
        "false_metal": share(metal > 0.5, matte),
        "false_mirror": share(roughness < MIRROR, matte),
        "all_metal": [truth["all_metal"], bool((metal > 0.5).mean() > ALL)],
        "mirrors": [bool((x < MIRROR).mean() > SOME) for x in (true_roughness, roughness)],
        **told_by(scene, truth),
        "calibration": {key: binned(found, BOUNDS[key]) for key, found in pairs.items()},
    }


def told_by(scene: Scene, truth: Mapping[str, Any]) -> dict[str, list[bool] | None]:
    """What the run's model says of the capture: [truth, found] of each; None: not to be asked."""
    varying = scene.cfg.varying
    return {
        # Gains are a makeshift where light varies, neither right nor wrong
        "exposures": None
        if truth["light_varies"]
        else [truth["exposures_differ"], varying == "exposure"],
        "light": [truth["light_varies"], varying == "light"],
        "turntable": [truth["turntable"], scene.cfg.turntable is not None],
        "flash": [truth["flash"], scene.cfg.flash is not None],
    }


def materials_of(path: Path, metallic: Tensor | None, roughness: Tensor) -> np.ndarray:
    """Found and true metal, found and true roughness, and the part: [5, N] of a view's object.

    Args:
        path: truth of the view, as in `lab.stress.scenes.truth_of_view`.
        metallic, roughness: [H * W] as recovered; metallic may be missing, where nothing is metal.
    """
    with np.load(path) as arrays:
        there = (arrays["alpha"] > 250).ravel() & (arrays["part"] < 255).ravel()
        true = [arrays[key].ravel() for key in ("metallic", "roughness", "part")]
    metal = torch.zeros_like(roughness) if metallic is None else metallic
    found = [metal.numpy(), true[0], roughness.numpy(), true[1], true[2]]
    return np.stack([value[there].astype(np.float32) for value in found])


def pieces(metal: np.ndarray, true: np.ndarray, part: np.ndarray) -> tuple[int, int]:
    """How many pieces of an object were told right, and how many there are."""
    right = asked = 0
    for one in np.unique(part):
        for is_metal in (False, True):
            piece = (part == one) & (true > 0.8 if is_metal else true < 0.2)
            if piece.sum() < LEAST * len(metal):
                continue
            asked += 1
            right += int(bool(metal[piece].mean() > 0.5) == is_metal)
    return right, asked


def share(which: np.ndarray, among: np.ndarray) -> float | None:
    """Of some pixels; None if there are too few."""
    return float(which[among].mean()) if among.mean() > LEAST else None


def binned(
    pairs: Sequence[tuple[Tensor, Tensor]], bounds: tuple[float, float]
) -> list[list[float]] | None:
    """Number of pixels, sums of expected and of true error, in bins of expected error: [BINS, 3].

    Args:
        bounds: of all bins; what lies beyond counts to the first and the last.
    """
    if not pairs:
        return None
    told, true = (torch.cat(x).double().numpy() for x in zip(*pairs, strict=True))
    edges = np.geomspace(*bounds, BINS + 1)[1:-1]
    place = np.digitize(told, edges)
    sums = [np.bincount(place, w, BINS) for w in (None, told, true)]
    return np.stack(sums, 1).round(4).tolist()


def summary(outcomes: Sequence[Outcome], found: Sequence[dict[str, Any] | None]) -> dict[str, Any]:
    """Means and shares over some scenes.

    Args:
        outcomes: of trainings, those that failed too.
        found: what `judged` says of each; None of those that failed.
    """
    judged = [one for one in found if one is not None]
    trained = [o for o in outcomes if not o.error]
    yes_or_no = {}
    for key in DECISIONS:
        told = [one[key] for one in judged if one[key] is not None]
        yes_or_no[key] = {
            "right": _mean([t == f for t, f in told]),
            "found": _mean([f for t, f in told if t]),
            "false": _mean([f for t, f in told if not t]),
            "count": len(told),
            "are": sum(t for t, _ in told),
        }
    right, asked = (sum(one["metal"][k] for one in judged) for k in (0, 1))
    return {
        "scenes": len(outcomes),
        "failed": len(outcomes) - len(trained),
        "measures": {k: _mean([o.measures.get(k) for o in trained]) for k in MEASURES},
        "ranks": {k: _mean([o.measures.get(k) for o in trained]) for k in RANKS},
        "metal": {"right": right / asked if asked else None, "count": asked},
        "decisions": yes_or_no,
        "matte": {key: _mean([one[key] for one in judged]) for key in SHARES},
        "calibration": {
            key: _pooled([one["calibration"][key] for one in judged]) for key in RANKS.values()
        },
    }


def _pooled(tables: Sequence[list[list[float]] | None]) -> list[list[float | None]]:
    """Share of the pixels, mean expected and mean true error in each bin; scenes count alike."""
    total = np.zeros((BINS, 3))
    known = [np.array(t) for t in tables if t is not None]
    for table in known:
        total += table / max(table[:, 0].sum(), 1) / len(known)
    return [
        [float(n), float(d / n) if n else None, float(e / n) if n else None] for n, d, e in total
    ]


def markdown(halves: Mapping[str, dict[str, Any]]) -> str:
    """Tables of summaries by half."""
    names = [half for half in HALVES if half in halves]
    head = f"| | {' | '.join(names)} |\n|---|{'---:|' * len(names)}"

    def row(title: str, values: Sequence[float | None], digits: int = 2) -> str:
        return f"| {title} | {' | '.join(_text(value, digits) for value in values)} |"

    every = [halves[name] for name in names]
    lines = [head, row("scenes", [h["scenes"] for h in every], 0)]
    lines.append(row("failed", [h["failed"] for h in every], 0))
    lines += [
        row(title, [h["measures"][k] for h in every], n) for k, (title, n) in MEASURES.items()
    ]
    lines += ["", head.replace("| |", "| right decisions |", 1)]
    lines.append(row("metal or not, of pieces of objects", [h["metal"]["right"] for h in every]))
    for key, title in DECISIONS.items():
        told = [h["decisions"][key] for h in every]
        are = " and ".join(str(t["are"]) for t in told)
        lines.append(row(title, [t["right"] for t in told]))
        lines.append(row(f"... found where it is ({are} scenes)", [t["found"] for t in told]))
        lines.append(row("... said where it is not", [t["false"] for t in told]))
    for key, title in SHARES.items():
        lines.append(row(f"share of matte surface {title}", [h["matte"][key] for h in every], 3))
    for measure, key in RANKS.items():
        lines += ["", head.replace("| |", f"| expected error of {key} |", 1)]
        ranks = [h["ranks"][measure] for h in every]
        lines.append(row("rank correlation with the error, mean of scenes", ranks))
        for k in range(BINS):
            cells = [h["calibration"][key][k] for h in every]
            shown = [f"{_text(n, 2)}: {_text(d, 3)}, {_text(e, 3)}" for n, d, e in cells]
            lines.append(f"| bin {k + 1} | {' | '.join(shown)} |")
    lines += ["", "By expected error: share of the pixels, their mean expected and true error."]
    return "\n".join(lines) + "\n"


def save(path: Path, found: dict[str, Any]) -> None:
    path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


def _mean(values: Sequence[float | bool | None]) -> float | None:
    known = [float(value) for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _text(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
