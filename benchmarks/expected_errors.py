"""Fit the weights of expected errors, `univoxel.evaluation.confidence.EXPECTED`, to training runs.

    univoxel lab bank --half tuning
    python benchmarks/expected_errors.py BANK [--label draft] [--half tuning]

BANK holds scenes/ and runs/. Prints the weights that fit all scenes, and how well those that are
fitted to the other scenes foretell each one: rank correlation, mean error by tenths of the expected
one, and below which expected error nine of ten places are good.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.spatial import KDTree

from lab.bank.measure import HALVES
from lab.bank.scenes import half_of
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
def collected(run: Path, data: Path) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Terms and true errors at random pixels of the test views where some photograph sees them."""
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
    seen = (surveyed.views > 0).numpy()[place].nonzero()[0]
    chosen = np.random.default_rng(0).permutation(seen)[:PIXELS]
    terms = {name: value.numpy()[place[chosen]] for name, value in surveyed.terms.items()}
    return terms, {name: np.concatenate(value)[chosen] for name, value in true.items()}


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


def report(name: str, terms: list[np.ndarray], errors: list[np.ndarray]) -> None:
    """Print the weights, and what those of the other scenes foretell of each."""
    names = list(EXPECTED[name][1])
    constant, *weights = fitted(terms, errors).round(2)
    print(f"{name}: {constant}, {dict(zip(names, map(float, weights), strict=True))}")
    told, ranks = [], []
    for k, own in enumerate(terms):
        others = [j for j in range(len(terms)) if j != k]
        told.append(foretold(fitted([terms[j] for j in others], [errors[j] for j in others]), own))
        ranks.append(spearman(torch.from_numpy(told[-1]), torch.from_numpy(errors[k])))
    p, y = np.concatenate(told), np.concatenate(errors)
    pooled = spearman(torch.from_numpy(p), torch.from_numpy(y))
    print(f"  rank correlation {np.mean(ranks):.2f} in a scene, {pooled:.2f} over all")
    order = np.argsort(p)
    tenths = ((p[k].mean(), y[k].mean()) for k in np.array_split(order, 10))
    print("  expected: true", *(f"{a:.3f}: {b:.3f}" for a, b in tenths))
    limit = GOOD[name][1]
    bad = np.cumsum(y[order] > limit) / np.arange(1, len(p) + 1)
    good = np.flatnonzero(bad <= 0.1)
    least = p[order[good[-1]]] if len(good) else 0.0
    print(f"  nine of ten below {limit:g} up to {least:.3f}, on {(p <= least).mean():.0%} of them")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("bank", type=Path)
    parser.add_argument("--label", default="draft", help="of the training runs")
    parser.add_argument("--half", choices=HALVES, default="tuning")
    parser.add_argument("--seed", type=int, default=0, help="of the bank")
    asked = parser.parse_args()
    found = []
    for scene in sorted((asked.bank / "scenes").iterdir()):
        run = asked.bank / "runs" / scene.name / asked.label / "run"
        if half_of(asked.seed, int(scene.name[-3:])) == asked.half and run.is_dir():
            found.append(collected(run, scene))
            print(scene.name, {k: round(float(v.mean()), 3) for k, v in found[-1][1].items()})
    for name, (_, weights) in EXPECTED.items():
        terms = [np.column_stack([t[key] for key in weights]).astype(float) for t, _ in found]
        report(name, terms, [e[name].astype(float) for _, e in found])


if __name__ == "__main__":
    main()
