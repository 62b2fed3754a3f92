"""Choices and defaults shared by configuration, package and command line. Imports no torch."""

from __future__ import annotations

from typing import Literal, TypeAlias, get_args

FieldName: TypeAlias = Literal["dense", "sparse", "hash"]
LightName: TypeAlias = Literal["hybrid", "sg", "sh", "mlp", "envmap-sg", "envmap", "baked"]
PresetName: TypeAlias = Literal["draft", "fast", "full", "best"]
PresetOrAuto: TypeAlias = Literal["auto", "draft", "fast", "full", "best"]
Capacity: TypeAlias = Literal["fixed", "adaptive"]
CapacityOrAuto: TypeAlias = Literal["auto", "adaptive", "fixed"]
CamerasFrom: TypeAlias = Literal["auto", "given", "refined"]
MasksFrom: TypeAlias = Literal["auto", "given"]
Varying: TypeAlias = Literal["none", "exposure", "light"]
Differing: TypeAlias = Literal["auto", "none", "exposure", "light"]
Metal: TypeAlias = Literal["auto", "all", "some"]
LightFrameOrAuto: TypeAlias = Literal["auto", "world", "turntable", "camera"]
Detailing: TypeAlias = Literal["none", "texture"]  # from photographs at their own size
DetailingOrAuto: TypeAlias = Literal["auto", "none", "texture"]
LIGHTS: tuple[LightName, ...] = get_args(LightName)

Background: TypeAlias = Literal["transparent", "map", "black"]
Behind: TypeAlias = Literal["black", "white"]  # what measured novel views are composited on
Ground: TypeAlias = float | Literal["lowest"] | None  # height of a floor, or at the lowest point
Downscale: TypeAlias = Literal["auto"] | int  # side of the squares of pixels that become one
Animation: TypeAlias = Literal["gif", "mp4"]
# Of rembg's networks those that find what stands out, by its names
NetworkName: TypeAlias = Literal[
    "u2netp", "silueta", "u2net", "isnet-general-use", "birefnet-general-lite", "birefnet-general"
]
# Lower and upper corner, x y z each
Box: TypeAlias = tuple[float, float, float, float, float, float]
Until: TypeAlias = Literal["cameras", "masks", "page"]  # the step that a capture ends with
BatchStep: TypeAlias = Literal["poses", "masks", "train", "eval", "export", "page"]
BATCH_STEPS: tuple[BatchStep, ...] = get_args(BatchStep)
USUAL_STEPS: tuple[BatchStep, ...] = ("train", "eval", "export", "page")
ANIMATIONS: tuple[Animation, ...] = get_args(Animation)
TextureFormat: TypeAlias = Literal["png", "jpeg"]
Origin: TypeAlias = Literal["upright", "world", "bottom", "centre"]  # where a mesh is exported to
TEXTURE_FORMATS: tuple[TextureFormat, ...] = get_args(TextureFormat)
ORIGINS: tuple[Origin, ...] = get_args(Origin)

DEPTH, REMBG = "none", "rembg"  # where masks come from, if not from a folder
NETWORK: NetworkName = "u2netp"  # the smallest: a second a photograph on one core
SAMPLES = 64  # of the light, per pixel of relit pictures
BOUNCES = 2  # reflections between parts of the object in relit pictures
ELEVATION = 25.0  # degrees, of an orbit's cameras above the object's middle
MAP_ROWS = 128  # of a written environment map
TEXTURE_SIZE = 1024  # texels along a side
TEXTURE_QUALITY = 90  # of JPEG textures
FEATURE_SIZE = 1200  # pixels along the longer side in which features of photographs are sought
KEEP_SIZE = 2000  # and at most of the photographs that are written: twice what grids can use
