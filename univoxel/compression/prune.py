"""Surgery on a trained scene: fewer channels, lobes, mirror levels and hidden units.

Everything here replaces networks and parameters by new ones and leaves the old as they were, so
that `snapshot` and `restore_` undo a trial.
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


@dataclass(frozen=True)
class Snapshot:
    """The networks, features and sizes of a scene at one time."""

    entries: tuple[tuple[Any, str, Any], ...]  # owner, attribute, value


def snapshot(scene: Scene) -> Snapshot:
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
    return Snapshot(
        tuple((owner, name, getattr(owner, name)) for owner, group in names for name in group)
    )


def restore_(before: Snapshot) -> None:
    """Give the scene of a snapshot the networks, features and sizes that it had then."""
    for owner, name, value in before.entries:
        setattr(owner, name, value)


def replaced_networks(before: Snapshot) -> list[nn.Module]:
    """The networks that the scene of a snapshot has now and did not have then."""
    present = ((getattr(owner, name), value) for owner, name, value in before.entries)
    return [now for now, then in present if now is not then and isinstance(now, nn.Module)]


def heads(scene: Scene) -> list[tuple[Any, str]]:
    """Owner and attribute of every network that reads features."""
    places: list[tuple[Any, str]] = [(scene.material, "net"), (scene.radiance, "net")]
    if isinstance(scene.light, AbstractLocalLight):
        places.append((scene.light, "head"))
    if scene.mirrored:
        places.append((scene.mirrored, "net"))
    return places


def rotate_(scene: Scene, basis: Tensor) -> None:
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
    scene.field.encoding.values = nn.Parameter(features @ basis.to(features))


def drop_channels_(scene: Scene, keep: Tensor, mean: Tensor) -> None:
    """Keep some of the feature channels; of the others the heads see the mean from now on.

    Args:
        keep: [K] increasing numbers, at least one of them a material channel.
        mean: [C] of the channels over the surface.
    """
    encoding = scene.field.encoding
    assert isinstance(encoding, NodeFeatures)
    channels, of_material = scene.cfg.channels, scene.material.channels
    dropped = torch.ones(channels, dtype=torch.bool)
    dropped[keep] = False
    for owner, name in heads(scene):
        weights, biases = _layers(getattr(owner, name))
        n = of_material if owner is scene.material else channels
        first, out = weights[0], dropped[:n]
        biases[0] = biases[0] + first[:, :n][:, out] @ mean[:n][out]
        weights[0] = torch.cat([first[:, :n][:, ~out], first[:, n:]], 1)
        setattr(owner, name, _network(weights, biases))
    scene.material.channels = int((keep < of_material).sum())
    scene.cfg = replace(scene.cfg, channels=len(keep), material_channels=scene.material.channels)
    encoding.keep_channels(keep)


def drop_lobes_(scene: Scene, keep: Tensor) -> None:
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


def drop_mirror_levels_(scene: Scene, levels: int) -> None:
    """Keep the coarsest levels of the table of mirrored directions; of the others the networks that
    read it see 0 from now on."""
    table = scene.radiance.directions
    dropped = table.channels - table.per_level * levels
    for owner in (scene.radiance, scene.mirrored):
        if owner is not None:
            weights, biases = _layers(owner.net)
            weights[0] = weights[0][:, : weights[0].shape[1] - dropped]
            owner.net = _network(weights, biases)
    table.table = nn.Parameter(table.table.data[: levels * table.rows].clone())
    scene.cfg = replace(scene.cfg, mirror_levels=levels)


def narrowed(net: MLP, x: Tensor, width: int, ridge: float) -> MLP:
    """The network with at most `width` units in every hidden layer.

    Units are kept in the order of QR with column pivoting: next comes the one of which the kept
    ones explain least, weighted by the next layer. The next layer takes from the kept ones what it
    had from the others, by a least-squares fit over x.

    Args:
        x: [N, sizes[0]] inputs of the network.
        ridge: damping of the fit, over the mean square of the kept units, > 0.
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
        gram.diagonal().add_(ridge * gram.diagonal().mean().clamp_min(1e-12))
        # Kept units stand for themselves, the fit for the others
        fit = torch.linalg.solve(gram, kept.T @ centred.double()).float()  # [K, H]
        fit[:, keep] = torch.eye(width)
        weights[i], biases[i] = weights[i][keep], biases[i][keep]
        biases[i + 1] = biases[i + 1] + weights[i + 1] @ (mean - mean[keep] @ fit)
        weights[i + 1] = weights[i + 1] @ fit.T
        h = h[:, keep]
    return _network(weights, biases)


@contextmanager
def recorded_inputs(scene: Scene) -> Iterator[dict[str, Tensor]]:
    """Inputs [N, inputs] of each head as run last in this block, by its owner's class name."""
    inputs: dict[str, Tensor] = {}

    def note(name: str, _: nn.Module, x: tuple[Tensor]) -> None:
        inputs[name] = x[0]

    hooks = [
        getattr(owner, name).register_forward_pre_hook(partial(note, type(owner).__name__))
        for owner, name in heads(scene)
    ]
    try:
        yield inputs
    finally:
        for hook in hooks:
            hook.remove()


def drop_units_(scene: Scene, width: int, inputs: dict[str, Tensor], ridge: float) -> None:
    """Keep at most `width` units in the hidden layers of every head.

    Args:
        inputs: of each head, as `recorded_inputs` gives them.
        ridge: see `narrowed`.
    """
    cfg, light = scene.cfg, scene.light
    light_config = light.narrowed(width) if isinstance(light, AbstractLocalLight) else None
    for owner, name in heads(scene):
        if owner is not light or light_config is not None:
            x = inputs[type(owner).__name__]
            setattr(owner, name, narrowed(getattr(owner, name), x, width, ridge))
    if isinstance(light, AbstractLocalLight) and light_config is not None:
        light.config = light_config
        cfg = replace(cfg, light=light_config)
    scene.cfg = replace(cfg, hidden=min(width, cfg.hidden))


def _layers(net: MLP) -> tuple[list[Tensor], list[Tensor]]:
    return [x.weight.data for x in net.linear], [x.bias.data for x in net.linear]


def _network(weights: list[Tensor], biases: list[Tensor]) -> MLP:
    net = MLP([weights[0].shape[1], *(len(w) for w in weights)])
    for layer, weight, bias in zip(net.linear, weights, biases, strict=True):
        layer.weight, layer.bias = nn.Parameter(weight.clone()), nn.Parameter(bias.clone())
    return net
