"""Draws docs/images/entropy.png: what paint in few colours tells of the light.

    python docs/figures/entropy.py docs/images

A matte ball of three paints stands under a sun and an even sky. Its photograph is divided by the
light that it had, and by an even one. The entropy is that of docs/method/optimisation.md.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np

SIZE = 240  # pixels
PAINTS = np.array([[0.62, 0.20, 0.14], [0.75, 0.66, 0.42], [0.16, 0.32, 0.48]])
SUN = np.array([0.55, 0.35, 0.75])
SUN_SHARE, SKY_SHARE = 0.75, 0.25
CELL = 0.15  # of log albedo, as EntropyConfig.cell


def ball() -> tuple[np.ndarray, np.ndarray]:
    """Normals [H, W, 3] of a ball seen along -Z, and which pixels show it."""
    x, y = np.meshgrid(*2 * [np.linspace(-1.05, 1.05, SIZE)])
    z = np.sqrt(np.clip(1 - x**2 - y**2, 0, None))
    return np.stack([x, -y, z], -1), x**2 + y**2 < 0.97


def paint(normal: np.ndarray) -> np.ndarray:
    """Albedo [H, W, 3]: bands of three paints, askew."""
    along = normal @ np.array([0.5, 0.8, 0.3])
    return PAINTS[np.floor(3.4 * along + 6).astype(int) % 3]


def entropy(albedo: np.ndarray) -> float:
    """Entropy in nats of albedos [N, 3] in cells of their logarithm."""
    cells = np.floor(np.log(albedo) / CELL).astype(int)
    share = np.unique(cells, axis=0, return_counts=True)[1] / len(cells)
    return float(-(share * np.log(share)).sum())


def encoded(color: np.ndarray, inside: np.ndarray) -> np.ndarray:
    return np.where(inside[..., None], np.clip(color, 0, 1) ** (1 / 2.2), 1)


def main() -> None:
    normal, inside = ball()
    cosine = np.clip(normal @ (SUN / np.linalg.norm(SUN)), 0, None)
    light = (SKY_SHARE + SUN_SHARE * 2 * cosine)[..., None]
    photograph = paint(normal) * light
    even = np.full_like(light, float(light[inside].mean()))
    right, wrong = photograph / light, photograph / even
    assert entropy(right[inside]) < entropy(wrong[inside])

    figure, panels = plt.subplots(1, 5, figsize=(10.5, 2.4), facecolor="white")
    titles = ("photograph", "divided by its light", "divided by an even one")
    for axes, picture, title in zip(panels, (photograph, right, wrong), titles, strict=False):
        axes.imshow(encoded(picture, inside))
        axes.set_title(title, size=9)
        axes.axis("off")
    for axes, albedo, title in ((panels[3], right, "right"), (panels[4], wrong, "even")):
        bins = np.arange(-2.6, 0.61, CELL)
        for c, color in enumerate(("#b0413e", "#4f8f5b", "#3a6ea5")):
            values = np.log(albedo[inside][:, c])
            axes.hist(values, bins, color=color, alpha=0.6, weights=np.full(len(values), 1.0))
        kind = "few colours: low entropy" if title == "right" else "many colours: high entropy"
        axes.set_title(kind, size=9)
        axes.set_xlabel("log albedo", size=8)
        axes.set_yticks([])
        axes.tick_params(labelsize=7)
    figure.tight_layout(w_pad=0.6)
    figure.savefig(Path(sys.argv[1]) / "entropy.png", dpi=100, metadata={"Software": None})


if __name__ == "__main__":
    main()
