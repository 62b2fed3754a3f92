"""Words that the configuration and the command line share. Imports no torch."""

from __future__ import annotations

from typing import Literal, TypeAlias, get_args

FieldName: TypeAlias = Literal["dense", "sparse", "hash"]
LightName: TypeAlias = Literal["hybrid", "sg", "sh", "mlp", "envmap-sg", "envmap"]
PresetName: TypeAlias = Literal["draft", "fast", "full"]
Capacity: TypeAlias = Literal["fixed", "adaptive"]
CamerasFrom: TypeAlias = Literal["auto", "given", "refined"]
MasksFrom: TypeAlias = Literal["auto", "given"]
Varying: TypeAlias = Literal["none", "exposure", "light"]
Differing: TypeAlias = Literal["auto", "none", "exposure", "light"]
FIELDS: tuple[FieldName, ...] = get_args(FieldName)
LIGHTS: tuple[LightName, ...] = get_args(LightName)
