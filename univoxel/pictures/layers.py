"""A view of a scene as layers: radiance, materials, geometry and relit radiance per pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace

from torch import Tensor

from univoxel.camera import Cameras
from univoxel.confidence.doubts import Doubts
from univoxel.records import Surface
from univoxel.render.pipeline import at_rays, shade, surface_of_view
from univoxel.render.relight import Lighting, TracedMesh, relight_surface
from univoxel.scene import Scene

DOUBTS = ("albedo", "roughness")


@dataclass(frozen=True)
class Layers:
    """One view, row 0 on top; colours linear and composited on black, the rest as it is."""

    rgb: Tensor  # [H, W, 3] physically based render
    albedo: Tensor  # [H, W, 3]
    roughness: Tensor  # [H, W], 0 where nothing is
    normal: Tensor  # [H, W, 3] world, 0 where nothing is
    alpha: Tensor  # [H, W]
    depth: Tensor  # [H, W] along the camera's -Z, world units, 0 where nothing is
    relit: dict[str, Tensor]  # [H, W, 3] by map
    relit_scaled: dict[str, Tensor]  # the same with the scaled albedo
    doubt: Tensor | None = None  # [H, W, 2] in [0, 1] of albedo and roughness, 0 where nothing is


@dataclass(frozen=True)
class Relighting:
    """How relit layers are made."""

    lights: dict[str, Lighting]  # by the name of their map
    traced: TracedMesh  # casts shadows and sends bounces
    scale: Tensor  # [3] of the albedo, for the second set of pictures
    samples: int  # of the light, per pixel
    bounces: int


def render_layers(
    scene: Scene,
    cameras: Cameras,
    view: int,
    relighting: Relighting | None = None,
    doubts: Doubts | None = None,
) -> Layers:
    """Render one view. Nothing is shaded where the opacity is 0."""
    whole, wo = surface_of_view(scene, cameras, view)
    there = whole.opacity > 0
    width, height = cameras.size(view)
    surface, wo = at_rays(whole, there), wo[there]

    def picture(values: Tensor) -> Tensor:
        out = values.new_zeros(len(there), *values.shape[1:])
        out[there] = values
        return out.reshape(height, width, *values.shape[1:])

    opacity = surface.opacity[:, None]
    relit, relit_scaled = {}, {}
    if relighting:
        # A scale above 1 must not make a surface that reflects more than it receives.
        bright = replace(surface, albedo=(surface.albedo * relighting.scale).clamp_max(1))
        mesh = relighting.traced.mesh
        if mesh.albedo is not None:
            mesh = replace(mesh, albedo=(mesh.albedo * relighting.scale).clamp_max(1))
        scaled_mesh = replace(relighting.traced, mesh=mesh)
        for name in relighting.lights:
            relit[name] = picture(opacity * _relight(relighting, name, surface, wo))
            scaled = _relight(replace(relighting, traced=scaled_mesh), name, bright, wo)
            relit_scaled[name] = picture(opacity * scaled)
    backward = cameras.camera_to_world[view, :, 2]
    return Layers(
        rgb=picture(opacity * shade(scene, surface, wo)),
        albedo=picture(opacity * surface.albedo),
        roughness=picture(surface.roughness),
        normal=picture(surface.normal),
        alpha=picture(surface.opacity),
        depth=picture(surface.depth * (wo @ backward)),
        relit=relit,
        relit_scaled=relit_scaled,
        doubt=picture(doubts.at(surface.position, surface.normal)) if doubts else None,
    )


def exr_channels(layers: Layers) -> dict[str, Tensor]:
    """The channels of a saved EXR file, [H, W] each: rgb.R, normal.X, relit_<map>.R and so on."""
    channels = {"alpha": layers.alpha, "depth": layers.depth, "roughness": layers.roughness}
    if layers.doubt is not None:
        channels |= {f"doubt.{c}": layers.doubt[..., k] for k, c in enumerate(DOUBTS)}
    colors = {"rgb": layers.rgb, "albedo": layers.albedo}
    colors |= {f"relit_{name}": rgb for name, rgb in layers.relit.items()}
    for name, value in colors.items():
        channels |= {f"{name}.{c}": value[..., k] for k, c in enumerate("RGB")}
    return channels | {f"normal.{c}": layers.normal[..., k] for k, c in enumerate("XYZ")}


def _relight(relighting: Relighting, name: str, surface: Surface, wo: Tensor) -> Tensor:
    return relight_surface(
        surface,
        wo,
        relighting.traced,
        relighting.lights[name],
        samples=relighting.samples,
        bounces=relighting.bounces,
    )
