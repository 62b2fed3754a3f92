"""Fit the weights of expected errors, `univoxel.evaluation.confidence.EXPECTED`, to training runs.

    univoxel lab bank --half tuning
    python benchmarks/expected_errors.py BANK [--label draft] [--half tuning] [--out FILE.json]

BANK holds scenes/ and runs/. Prints the weights that fit all scenes, and how well those that are
fitted to the other scenes foretell each one: rank correlation, mean error by tenths of the expected
one, and how many of the places that are called good are so. Prints also the mean errors where no
photograph sees the surface, `UNSEEN`.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from made import made
from scipy.optimize import minimize
from scipy.spatial import KDTree

from lab.bank.measure import HALVES
from lab.bank.scenes import half_of
from lab.record import result_text
from univoxel.data import load_photos
from univoxel.evaluation.confidence import EXPECTED, GOOD, POINTS, QUANTITIES, key_of, survey
from univoxel.evaluation.measures import albedo_scales, errors_of, expected_view, render_layers
from univoxel.render.metrics import spearman
from univoxel.run import photos_of
from univoxel.scene import load_checkpoint

PIXELS = 3000  # of a scene
PRIOR = 1e-3  # weight of the squared standardised weights


class Constant:
    """In place of expected errors: all are 1, so that pixels and true errors are found as usual."""

    def at(self, position: torch.Tensor, normal: torch.Tensor) -> torch.Tensor:
        self.asked = position, normal
        return torch.ones(len(position), len(QUANTITIES))


@torch.no_grad()
def collected(
    run: Path, data: Path
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Terms and true errors at random pixels of the test views where some photograph sees them; and
    true errors at all where none does."""
    scene, _ = load_checkpoint(run)
    surveyed = survey(scene, photos_of(run, split="train"), POINTS)
    tree = KDTree(key_of(surveyed.position, surveyed.normal, surveyed.voxel_size))
    test = load_photos(data, "test")
    scales, near, true = albedo_scales(scene, test), [], {name: [] for name in QUANTITIES}
    for view in range(len(test)):
        constant = Constant()
        layers = render_layers(scene, test.cameras, view, None, constant)
        expected = expected_view(test, {}, view)
        inside = (expected.truth.mask & (layers.alpha > 0))[layers.alpha > 0]
        key = key_of(*(x[inside] for x in constant.asked), surveyed.voxel_size)
        near.append(tree.query(key, workers=-1)[1])
        for name, pairs in errors_of(layers, expected, scales).items():
            true[name].append(pairs[1].numpy())
    place = np.concatenate(near)
    seen = (surveyed.views > 0).numpy()[place]
    chosen = np.random.default_rng(0).permutation(seen.nonzero()[0])[:PIXELS]
    terms = {name: value.numpy()[place[chosen]] for name, value in surveyed.terms.items()}
    errors = {name: np.concatenate(value) for name, value in true.items()}
    return terms, *({k: v[which] for k, v in errors.items()} for which in (chosen, ~seen))


def fitted(terms: list[np.ndarray], errors: list[np.ndarray]) -> np.ndarray:
    """Weights [1 + T] of a constant and terms [N, T] by quasi-likelihood of the mean; scenes count
    alike."""
    x, y = np.concatenate(terms), np.concatenate(errors)
    weight = np.concatenate([np.full(len(e), 1 / len(e) / len(errors)) for e in errors])
    mean, scale = x.mean(0), x.std(0) + 1e-9
    z = np.column_stack([np.ones(len(x)), (x - mean) / scale])
    level = weight @ y

    def cost(w: np.ndarray) -> tuple[float, np.ndarray]:
        log_error = np.clip(z @ w, -20, 10)
        error = np.exp(log_error)
        value = weight @ (error - y * log_error) / level + PRIOR * (w[1:] ** 2).sum()
        return value, z.T @ (weight * (error - y)) / level + 2 * PRIOR * np.r_[0, w[1:]]

    start = np.r_[np.log(level), np.zeros(len(mean))]
    found = minimize(cost, start, jac=True, method="L-BFGS-B").x
    slopes = found[1:] / scale
    return np.r_[found[0] - slopes @ mean, slopes]


def foretold(w: np.ndarray, terms: np.ndarray) -> np.ndarray:
    return np.exp(w[0] + terms @ w[1:])


@dataclass(frozen=True)
class Report:
    """How well weights that were fitted to the other scenes foretell each scene."""

    in_a_scene: float  # rank correlation, mean of the scenes
    over_all: float  # rank correlation of all pixels
    tenths: list[tuple[float, float]]  # mean expected and true error, by expected error
    called_good: float  # share of the pixels, by `confidence.GOOD`; 0: none is ever called so
    right: float  # share of these whose error is below the limit


def report_of(name: str, terms: list[np.ndarray], errors: list[np.ndarray]) -> Report:
    told, ranks = [], []
    for k, own in enumerate(terms):
        others = [j for j in range(len(terms)) if j != k]
        told.append(foretold(fitted([terms[j] for j in others], [errors[j] for j in others]), own))
        ranks.append(spearman(torch.from_numpy(told[-1]), torch.from_numpy(errors[k])))
    p, y = np.concatenate(told), np.concatenate(errors)
    order = np.argsort(p)
    tenths = [(float(p[k].mean()), float(y[k].mean())) for k in np.array_split(order, 10)]
    most, limit = GOOD.get(name, (0.0, 0.0))
    good, pooled = p < most, spearman(torch.from_numpy(p), torch.from_numpy(y))
    right = float((y[good] < limit).mean()) if good.any() else 0.0
    return Report(float(np.mean(ranks)), float(pooled), tenths, float(good.mean()), right)


def record_of(reports: dict[str, Report], label: str, half: str, count: int) -> dict[str, Any]:
    """A table for the pages."""
    ranks = (f"{n} {r.in_a_scene:.2f} and {r.over_all:.2f}" for n, r in reports.items())
    digits = {"albedo": 3, "roughness": 2, "normal": 1}
    units = {"albedo": "sRGB", "roughness": "0 to 1", "normal": "degrees"}
    columns = [
        {"name": f"{name}, {what}", "digits": digits[name], "unit": units[name]}
        for name in reports
        for what in ("expected", "true")
    ]
    rows = [
        [tenth + 1, *(x for report in reports.values() for x in report.tenths[tenth])]
        for tenth in range(10)
    ]
    return {
        "title": f"Expected and true errors by tenths of the pixels, {half} half, `{label}`",
        **made(),
        "note": f"{count} scenes. Rank correlation in a scene and over all: {'; '.join(ranks)}.",
        "columns": [{"name": "tenth"}, *columns],
        "rows": rows,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("bank", type=Path)
    parser.add_argument("--label", default="draft", help="of the training runs")
    parser.add_argument("--half", choices=HALVES, default="tuning")
    parser.add_argument("--seed", type=int, default=0, help="of the bank")
    parser.add_argument("--out", type=Path, help="a table for the pages")
    asked = parser.parse_args()
    found = []
    for scene in sorted((asked.bank / "scenes").iterdir()):
        run = asked.bank / "runs" / scene.name / asked.label / "run"
        if half_of(asked.seed, int(scene.name[-3:])) == asked.half and run.is_dir():
            found.append(collected(run, scene))
            print(scene.name, {k: round(float(v.mean()), 3) for k, v in found[-1][1].items()})
    reports = {}
    for name, (_, weights) in EXPECTED.items():
        terms = [np.column_stack([t[key] for key in weights]).astype(float) for t, *_ in found]
        errors = [e[name].astype(float) for _, e, _ in found]
        constant, *others = fitted(terms, errors).round(2)
        print(f"{name}: {constant}, {dict(zip(weights, map(float, others), strict=True))}")
        reports[name] = report_of(name, terms, errors)
        print(f"  {reports[name]}")
        unseen = np.concatenate([u[name] for *_, u in found])
        print(f"  unseen: {unseen.mean():.3f} over {len(unseen)} pixels")
    if asked.out:
        asked.out.write_text(result_text(record_of(reports, asked.label, asked.half, len(found))))


if __name__ == "__main__":
    main()
