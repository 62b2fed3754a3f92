"""A scene: field, heads and light."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, get_args

import torch
from torch import Tensor, nn

from univoxel.data import Photos
from univoxel.errors import ConfigError, UserError
from univoxel.fields.distances import SurfaceVersion
from univoxel.fields.field import Field
from univoxel.fields.heads import MaterialHead, RadianceHead
from univoxel.lights import (
    AbstractLight,
    AbstractLocalLight,
    EnvmapLight,
    EnvmapSGLight,
    LightConfig,
    LocalLightConfig,
    SGConfig,
    build,
)
from univoxel.lights.base import MOST_ROWS
from univoxel.lights.mirrored import MirroredLight
from univoxel.lights.nodes import DistantLight
from univoxel.lights.turntable import Turntable
from univoxel.lights.views import ViewLights
from univoxel.names import Varying
from univoxel.ops import VisibilityScene
from univoxel.poses import PoseSteps
from univoxel.validation import check_fields


@dataclass(frozen=True)
class SceneConfig:
    """Sizes of the model."""

    channels: int = 16  # features per voxel, >= 1
    material_channels: int = 8  # of them, that albedo and roughness are decoded from, >= 1
    hidden: int = 64  # width of the material and radiance heads, >= 1
    mirror_levels: int = 5  # of the table of mirrored directions, 29 degrees and finer, [0, 8]
    sky_nodes: int = 512  # directions of the environment map, >= 0; 0: the scene has none
    # rows of the map's texels, >= 0, where polished things show it more sharply than its nodes do;
    # training fills them in
    sky_rows: int = 0
    mirrored: bool = True  # whether a local light gets a network for what is mirrored sharply
    # the light that photographs are rendered with, and its own sizes
    light: LightConfig = field(default_factory=SGConfig)
    # Of everything, in (0, 1], where it is known and nothing is metal; None: both are learned
    roughness: float | None = None
    # about which the light turns with the camera; None: it stands still
    turntable: Turntable | None = None
    varying: Varying = "none"  # what differs from photograph to photograph, see ViewLights
    codes: int = 8  # numbers that tell the light of a view, where that varies, >= 1
    # whether the photographs' cameras are learned too, see PoseSteps; training fills it in
    refined: bool = False
    # names of the photographs, where something differs from one to another; training fills them in
    views: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        counts = ("channels", "material_channels", "hidden", "codes")
        check_fields(self, "at least 1", lambda x: x >= 1, *counts)
        check_fields(self, "at least 0", lambda x: x >= 0, "sky_nodes")
        check_fields(self, "in [0, 8]", lambda x: 0 <= x <= 8, "mirror_levels")
        check_fields(self, f"in [0, {MOST_ROWS}]", lambda x: 0 <= x <= MOST_ROWS, "sky_rows")
        most = f"at most channels ({self.channels})"
        check_fields(self, most, lambda x: x <= self.channels, "material_channels")
        check_fields(self, "None or in (0, 1]", lambda x: x is None or 0 < x <= 1, "roughness")
        check_fields(self, "none, exposure or light", lambda x: x in get_args(Varying), "varying")
        if self.turntable is not None and not isinstance(self.light, LocalLightConfig):
            raise ConfigError(
                "SceneConfig: light that turns with the camera needs hybrid or a local light, sg, "
                f"sh or mlp, got {self.light.kind}",
                "light_frame",
                "light",
            )
        if self.turntable is not None and self.varying == "light":
            raise ConfigError(
                "SceneConfig: light that turns with the camera cannot vary otherwise too; varying "
                "exposure goes with it",
                "light_frame",
                "varying",
            )
        if self.varying == "light" and not isinstance(self.light, LocalLightConfig):
            raise ConfigError(
                "SceneConfig: varying light needs hybrid or a local light, sg, sh or mlp, got "
                f"{self.light.kind}; varying exposure goes with every light"
            )


class Scene(nn.Module):
    """Everything that is learned of an object and of the light it stood in."""

    def __init__(self, cfg: SceneConfig, field: Field, inv_s: float = 1.0) -> None:
        super().__init__()
        self.cfg: SceneConfig = cfg
        self.inv_s = inv_s  # sharpness of the NeuS density, 1 / world units
        self.field = field
        self.material: MaterialHead = MaterialHead(cfg.material_channels, cfg.hidden, cfg.roughness)
        codes = cfg.codes if cfg.varying == "light" else 0
        inputs = cfg.channels + codes  # of what draws photographs: features and the view's code
        self.radiance: RadianceHead = RadianceHead(inputs, cfg.hidden, cfg.mirror_levels)
        self.light: AbstractLight = build(inputs, cfg.light)
        self.sky: DistantLight | None = None
        if cfg.sky_nodes:
            self.sky = DistantLight(cfg.sky_nodes, rows=cfg.sky_rows)
        self.mirrored = None
        if cfg.mirrored and isinstance(cfg.light, LocalLightConfig):
            known = self.radiance.directions.channels
            self.mirrored: MirroredLight | None = MirroredLight(
                inputs, cfg.hidden, cfg.light.scale, known
            )
        self.views = None
        if cfg.varying != "none":
            directions = self.sky.direction if codes and self.sky else None
            self.views: ViewLights | None = ViewLights(cfg.views, codes, directions)
        self.poses: PoseSteps | None = PoseSteps(len(cfg.views)) if cfg.refined else None
        if codes:  # at first they change nothing
            assert isinstance(self.light, AbstractLocalLight)
            nets = [self.radiance.net, self.light.head]
            nets += [self.mirrored.net] if self.mirrored else []
            for net in nets:
                net.linear[0].weight.data[:, cfg.channels : inputs] = 0
        self._traced: tuple[VisibilityScene, SurfaceVersion] | None = None  # see `occluder`
        self._held = False

    def coded(self, features: Tensor, view: Tensor | int | None = None) -> Tensor:
        """Features [N, C] as the networks of light read them: [N, C + Z], with the view's code.

        Args:
            view: [N] int64 number of a photograph, or one for all; None: the light that is shown.
        """
        code = None if self.views is None else self.views.code(view)
        if code is None:
            return features
        return torch.cat([features, code.expand(len(features), -1)], 1)

    def exposed(self, radiance: Tensor, view: Tensor | int | None = None) -> Tensor:
        """Linear radiance [N, 3] with the gain of photographs; view as in `coded`."""
        return radiance if self.views is None else radiance * self.views.gain(view)

    def registered(self, photos: Photos) -> Photos:
        """The photographs that it was trained on, their cameras where they are believed to be.

        Raises:
            ValueError: other photographs, where cameras are refined.
        """
        if self.poses is None:
            return photos
        return replace(photos, cameras=self.poses.corrected(photos.cameras))

    def show_light_of(self, view: str | None) -> None:
        """Choose the photograph, by name or number, whose light is shown; None: the mean of all.

        Raises:
            ValueError: no such photograph, or the scene has one light for all.
        """
        if self.views is not None:
            self.views.choose(view)
        elif view is not None:
            raise UserError(
                f"light_of: all views of this run have one light, got {view!r}; it was trained "
                "without varying",
                "light_of",
                "varying",
            )

    def sharpen_sky(self, radiance: Tensor) -> None:
        """Keep texels [R, 2 R, 3] of the map, linear, beside its nodes."""
        assert self.sky is not None
        self.sky.sharp = radiance
        self.cfg = replace(self.cfg, sky_rows=len(radiance))

    def occluder(self) -> VisibilityScene:
        """The present surface, ready for rays; within `surface_held`, the one that is held.

        Raises:
            ValueError: the scene has no surface.
        """
        if self._traced is not None:
            tracer, version = self._traced
            if self._held or version.holds(self.field.sdf):
                return tracer
        tracer = VisibilityScene(*self.field.isosurface())
        self._traced = tracer, SurfaceVersion.of(self.field.sdf)
        return tracer

    @contextmanager
    def surface_held(self) -> Iterator[None]:
        """A block in which `occluder` stays as it was first asked for, though the surface moves,
        until `release_surface`: tracing anew in every step would cost more than the step."""
        stale = self._traced is not None and not self._traced[1].holds(self.field.sdf)
        if stale and not self._held:
            self._traced = None
        before, self._held = self._held, True
        try:
            yield
        finally:
            self._held = before

    def release_surface(self) -> None:
        """Within `surface_held`: hold the present surface from now on."""
        self._traced = None

    def __getstate__(self) -> dict[str, Any]:
        """For copies: what traces rays cannot be copied, and is made again."""
        return self.__dict__ | {"_traced": None, "_held": False}

    def environment(self) -> DistantLight | EnvmapLight | EnvmapSGLight | None:
        """The one distant map that the scene stood in, where it has one; without gains."""
        if isinstance(self.light, EnvmapLight | EnvmapSGLight):
            return self.light
        change = self.views.sky_change() if self.views else None
        if self.sky is None or self.views is None or self.views.chosen is None or change is None:
            return self.sky
        return self.sky.changed(change[self.views.chosen])
