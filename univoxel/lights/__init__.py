"""Lighting models: the light that reaches a surface point, and what the point reflects."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeAlias, get_args

import torch

from univoxel.core.validation import record
from univoxel.errors import ConfigError
from univoxel.lights.baked import BakedConfig, BakedLight
from univoxel.lights.base import AbstractLight, AbstractLocalLight, LocalLightConfig
from univoxel.lights.envmap import EnvmapConfig, EnvmapLight, EnvmapSGConfig, EnvmapSGLight
from univoxel.lights.mlp import LocalMLP, MLPLightConfig
from univoxel.lights.sg import LocalSG, SGConfig
from univoxel.lights.sh import LocalSH, SHConfig

LightConfig: TypeAlias = (
    SGConfig | SHConfig | MLPLightConfig | EnvmapSGConfig | EnvmapConfig | BakedConfig
)

# fmt: off
__all__ = [
    "AbstractLight", "AbstractLocalLight", "BakedConfig", "BakedLight", "EnvmapConfig",
    "EnvmapLight", "EnvmapSGConfig", "EnvmapSGLight", "LightConfig", "LocalLightConfig", "LocalMLP",
    "LocalSG", "LocalSH", "MLPLightConfig", "SGConfig", "SHConfig", "build", "read_config",
    "scaled",
]
# fmt: on


def build(
    features: int, config: LightConfig, generator: torch.Generator | None = None
) -> AbstractLight:
    """The light that a configuration describes.

    Args:
        features: C of Surface.features, that local lights read.
        generator: draws the first weights of networks.
    """
    match config:
        case SGConfig():
            return LocalSG(features, config, generator)
        case SHConfig():
            return LocalSH(features, config, generator)
        case MLPLightConfig():
            return LocalMLP(features, config, generator)
        case EnvmapSGConfig():
            return EnvmapSGLight(config)
        case EnvmapConfig():
            return EnvmapLight(config)
        case BakedConfig():
            return BakedLight(config)


def scaled(config: LightConfig, scale: float) -> LightConfig:
    """The configuration for an object of half extent `scale`, world units, where it has one."""
    return replace(config, scale=scale) if isinstance(config, LocalLightConfig) else config


def read_config(values: dict[str, Any]) -> LightConfig:
    """The configuration that dataclasses.asdict made a dictionary of.

    Raises:
        ConfigError: no such light; a field that it has not, or of another type; a number outside
            its range.
    """
    if not isinstance(values, dict):
        raise ConfigError(f"light must be a JSON object, got {values!r:.60}")
    values = dict(values)
    kind = values.pop("kind", "sg")  # files from before there were others do not say
    kinds = {c.kind: c for c in get_args(LightConfig)}
    if not isinstance(kind, str) or kind not in kinds:
        raise ConfigError(f"light must be one of {', '.join(kinds)}, got {kind!r}")
    return record(kinds[kind], values)
