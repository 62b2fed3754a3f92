"""A trained scene with fewer channels, lobes and hidden units, which says nearly the same.

Everything here replaces networks and parameters by new ones and leaves the old as they were, so
that `parts_of` and `put_back` undo a trial.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.linalg import qr
from torch import Tensor, nn

from univoxel.fields.features import NodeFeatures
from univoxel.lights import AbstractLocalLight, LocalSG
from univoxel.networks import MLP
from univoxel.scene import Scene

RIDGE = 1e-4  # of the mean square: what a fit of what is dropped by what is kept is damped by


@dataclass(frozen=True)
class Parts:
    """What this module replaces: (owner, attribute, what it was)."""

    held: tuple[tuple[Any, str, Any], ...]


def parts_of(scene: Scene) -> Parts:
    """The present networks, features and sizes of a scene."""
    names = [
        (scene, ("cfg",)),
        (scene.field, ("features",)),
        (scene.material, ("net", "channels")),
        (scene.radiance, ("net",)),
        (scene.radiance.directions, ("table",)),
    ]
    if isinstance(scene.light, AbstractLocalLight):
        names.append((scene.light, ("head", "base", "config")))
    if scene.mirrored:
        names.append((scene.mirrored, ("net",)))
    return Parts(tuple((o, n, getattr(o, n)) for o, some in names for n in some))


def put_back(parts: Parts) -> None:
    """Undo what was done to the scene since `parts_of`."""
    for owner, name, value in parts.held:
        setattr(owner, name, value)


def heads(scene: Scene) -> list[tuple[Any, str]]:
    """Owner and attribute of every network that reads features."""
    found: list[tuple[Any, str]] = [(scene.material, "net"), (scene.radiance, "net")]
    if isinstance(scene.light, AbstractLocalLight):
        found.append((scene.light, "head"))
    if scene.mirrored:
        found.append((scene.mirrored, "net"))
    return found


def rotate(scene: Scene, basis: Tensor) -> None:
    """Change the features to features @ basis and every first layer such that nothing changes.

    Args:
        basis: [C, C] invertible; block diagonal, for the first `material_channels` are what
            materials are decoded from and stay so.
    """
    inverse = torch.linalg.inv(basis.double())
    for owner, name in heads(scene):
        net = getattr(owner, name)
        weights, biases = _layers(net)
        n = scene.material.channels if owner is scene.material else len(basis)
        first = weights[0].double()
        weights[0] = torch.cat([first[:, :n] @ inverse[:n, :n].T, first[:, n:]], 1).float()
        setattr(owner, name, _network(weights, biases))
    features = scene.field.features.data
    scene.field.features = nn.Parameter(features @ basis.to(features))


def drop_channels(scene: Scene, keep: Tensor, mean: Tensor) -> None:
    """Keep some of the feature channels; of the others the heads see the mean from now on.

    Args:
        keep: [K] increasing numbers, at least one of them a material channel.
        mean: [C] of the channels over the surface.
    """
    encoding = scene.field.encoding
    assert isinstance(encoding, NodeFeatures)
    channels, of_material = scene.cfg.channels, scene.material.channels
    gone = torch.ones(channels, dtype=torch.bool)
    gone[keep] = False
    for owner, name in heads(scene):
        weights, biases = _layers(getattr(owner, name))
        n = of_material if owner is scene.material else channels
        first, out = weights[0], gone[:n]
        biases[0] = biases[0] + first[:, :n][:, out] @ mean[:n][out]
        weights[0] = torch.cat([first[:, :n][:, ~out], first[:, n:]], 1)
        setattr(owner, name, _network(weights, biases))
    scene.material.channels = int((keep < of_material).sum())
    scene.cfg = replace(scene.cfg, channels=len(keep), material_channels=scene.material.channels)
    encoding.keep_channels(keep)


def drop_lobes(scene: Scene, keep: Tensor) -> None:
    """Keep the lobes [K] of a light of spherical Gaussians; the others go dark."""
    light = scene.light
    assert isinstance(light, LocalSG)
    weights, biases = _layers(light.head)
    rows = (7 * keep[:, None] + torch.arange(7)).flatten()
    weights[-1], biases[-1] = weights[-1][rows], biases[-1][rows]
    light.head = _network(weights, biases)
    light.base = nn.Parameter(light.base.data[keep])
    light.config = replace(light.config, lobes=len(keep))
    scene.cfg = replace(scene.cfg, light=light.config)


def drop_mirror_levels(scene: Scene, levels: int) -> None:
    """Keep the coarsest levels of the table of mirrored directions; of the others the networks that
    read it see 0 from now on."""
    table = scene.radiance.directions
    gone = table.channels - table.per_level * levels
    for owner in (scene.radiance, scene.mirrored):
        if owner is not None:
            weights, biases = _layers(owner.net)
            weights[0] = weights[0][:, : weights[0].shape[1] - gone]
            owner.net = _network(weights, biases)
    table.table = nn.Parameter(table.table.data[: levels * table.rows].clone())
    scene.cfg = replace(scene.cfg, mirror_levels=levels)


def narrow(net: MLP, x: Tensor, width: int) -> MLP:
    """The network with at most `width` units in every hidden layer.

    Units are kept in the order of what the kept ones cannot say of them, weighted by what the next
    layer makes of it (QR with column pivoting); the next layer takes from the kept ones what it had
    from the others, as far as a least-squares fit over x can tell.

    Args:
        x: [N, sizes[0]] what the network reads.
    """
    weights, biases = _layers(net)
    h = x
    for i in range(len(weights) - 1):
        h = torch.relu(h @ weights[i].T + biases[i])
        if h.shape[1] <= width:
            continue
        mean = h.mean(0)
        centred = h - mean
        weighted = centred * weights[i + 1].norm(dim=0)
        order = np.asarray(qr(weighted.numpy(), mode="r", pivoting=True)[-1])
        keep = torch.from_numpy(order[:width].copy()).long().sort().values
        kept = centred[:, keep].double()
        gram = kept.T @ kept
        gram.diagonal().add_(RIDGE * gram.diagonal().mean().clamp_min(1e-12))
        # What is kept stands for itself; of the others the fit
        said = torch.linalg.solve(gram, kept.T @ centred.double()).float()  # [K, H]
        said[:, keep] = torch.eye(width)
        weights[i], biases[i] = weights[i][keep], biases[i][keep]
        biases[i + 1] = biases[i + 1] + weights[i + 1] @ (mean - mean[keep] @ said)
        weights[i + 1] = weights[i + 1] @ said.T
        h = h[:, keep]
    return _network(weights, biases)


@contextmanager
def reads(scene: Scene) -> Iterator[dict[str, Tensor]]:
    """What each head reads in this block, by the name of its owner's class."""
    read: dict[str, Tensor] = {}

    def note(name: str, _: nn.Module, x: tuple[Tensor]) -> None:
        read[name] = x[0]

    hooks = [
        getattr(owner, name).register_forward_pre_hook(partial(note, type(owner).__name__))
        for owner, name in heads(scene)
    ]
    try:
        yield read
    finally:
        for hook in hooks:
            hook.remove()


def drop_units(scene: Scene, width: int, read: dict[str, Tensor]) -> None:
    """At most `width` units in the hidden layers of every head.

    Args:
        read: what each head reads, [N, inputs], by the name of its owner's class; see `reads`.
    """
    cfg, light = scene.cfg, scene.light
    narrowed = light.narrowed(width) if isinstance(light, AbstractLocalLight) else None
    for owner, name in heads(scene):
        if owner is not light or narrowed is not None:
            setattr(owner, name, narrow(getattr(owner, name), read[type(owner).__name__], width))
    if isinstance(light, AbstractLocalLight) and narrowed is not None:
        light.config = narrowed
        cfg = replace(cfg, light=narrowed)
    scene.cfg = replace(cfg, hidden=min(width, cfg.hidden))


def _layers(net: MLP) -> tuple[list[Tensor], list[Tensor]]:
    return [x.weight.data for x in net.linear], [x.bias.data for x in net.linear]


def _network(weights: list[Tensor], biases: list[Tensor]) -> MLP:
    net = MLP([weights[0].shape[1], *(len(w) for w in weights)])
    for layer, weight, bias in zip(net.linear, weights, biases, strict=True):
        layer.weight, layer.bias = nn.Parameter(weight.clone()), nn.Parameter(bias.clone())
    return net
