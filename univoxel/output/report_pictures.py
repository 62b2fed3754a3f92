"""Images of a report: photographs beside renders, four sides, the light, diagrams."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from univoxel.brdf import metal_or_none
from univoxel.camera import Cameras, resize
from univoxel.color import linear_to_srgb, luminance
from univoxel.core.choices import ELEVATION
from univoxel.core.html import escape
from univoxel.core.progress_bar import track
from univoxel.core.records import AlbedoNear, Mesh, Surface
from univoxel.data import Photos
from univoxel.evaluation.confidence import (
    ALBEDO_LIMIT,
    Advice,
    ExpectedErrors,
    azimuths,
    elevations,
)
from univoxel.lights import AbstractLocalLight
from univoxel.output.viewpoints import orbit
from univoxel.render.metrics import psnr
from univoxel.render.observations import surface_points
from univoxel.render.pictures import heat, map_and_balls, shrunk
from univoxel.render.pipeline import shade_hits, surface_of_view
from univoxel.scene import Scene
from univoxel.sphere import latlong_directions

SCOUTED = 48  # pixels along a picture by which views are compared
MOST = 150  # photographs that are compared, spread over all
LIMIT = 0.2  # mean difference in sRGB that is drawn brightest
BEHIND = 0.11  # sRGB, behind the object


@dataclass(frozen=True)
class Split:
    """Photographs, with cameras where they are believed to be."""

    photos: Photos
    trained: bool  # whether training saw them: then each has its own exposure and light


@dataclass(frozen=True)
class Compared:
    """A photograph and a render [h, w, 3], sRGB on the same grey."""

    name: str
    trained: bool
    photograph: Tensor
    render: Tensor
    inside: Tensor  # [h, w] bool: where either shows the object

    @property
    def difference(self) -> Tensor:
        """[h, w] mean absolute difference."""
        return (self.render - self.photograph).abs().mean(-1)

    @property
    def error(self) -> float:
        """Its mean over the object."""
        return float(self.difference[self.inside].mean()) if self.inside.any() else 0.0

    @property
    def quality(self) -> float:
        """PSNR over the object, dB."""
        inside = self.inside if self.inside.any() else torch.ones_like(self.inside)
        return float(psnr(self.render[inside], self.photograph[inside]))

    @property
    def tiles(self) -> tuple[Tensor, Tensor, Tensor]:
        """Photograph, render and difference as colours."""
        return self.photograph, self.render, torch.from_numpy(heat(self.difference, LIMIT))


def worst(
    scene: Scene, splits: list[Split], count: int, size: int, albedo_near: AlbedoNear | None = None
) -> tuple[list[Compared], int]:
    """The views that differ most from their photographs, the worst first, with at most `size`
    pixels along their pictures; how many were compared."""
    views = [(split, view) for split in splits for view in range(len(split.photos))]
    every = -(-len(views) // MOST)
    views = views[::every]
    errors = [
        compared(scene, split, view, SCOUTED, albedo_near).error
        for split, view in track(views, "comparing photographs")
    ]
    order = sorted(range(len(views)), key=lambda k: -errors[k])[:count]
    found = [compared(scene, *views[k], size, albedo_near) for k in order]
    return sorted(found, key=lambda view: -view.error), len(views)


@torch.no_grad()
def compared(
    scene: Scene, split: Split, view: int, size: int, albedo_near: AlbedoNear | None = None
) -> Compared:
    """One view, at most `size` pixels along its longer side."""
    photos = split.photos
    share = min(1.0, size / max(photos.cameras.size(view)))
    cameras = resize(photos.cameras, max(1, round(share * photos.cameras.width)))
    width, height = cameras.size(view)
    small = shrunk(photos, view, width, height)
    surface, wo = surface_of_view(scene, cameras, view, albedo_near)
    rgb = shade_hits(scene, surface, wo, view if split.trained else None)
    opacity = surface.opacity.reshape(height, width)
    both = (small[..., :3], small[..., 3]), (rgb.reshape(height, width, 3), opacity)
    photograph, render = (on_grey(rgb, alpha) for rgb, alpha in both)
    inside = (small[..., 3] > 0.5) | (opacity > 0.5)
    return Compared(photos.names[view], split.trained, photograph, render, inside)


def on_grey(premultiplied: Tensor, alpha: Tensor) -> Tensor:
    """Linear colours [h, w, 3], premultiplied, as sRGB on what is behind them in a report."""
    straight = premultiplied / alpha[..., None].clamp_min(1e-6)
    return linear_to_srgb(straight) * alpha[..., None] + BEHIND * (1 - alpha[..., None])


# The object from four sides, as layers.


SIDES = ("front", "right", "back", "left")


@torch.no_grad()
def layers(
    scene: Scene,
    mesh: Mesh,
    size: int,
    front: float,
    errors: ExpectedErrors | None,
    albedo_near: AlbedoNear | None = None,
) -> dict[str, list[Tensor]]:
    """Pictures [size, size, 3], sRGB, of each of SIDES, the front at an azimuth in degrees from +X,
    by layer: render, albedo, roughness, metal where there is any, normal, and the expected error of
    the albedo where it is known."""
    cameras = orbit(mesh, len(SIDES), size, ELEVATION, front)
    found: dict[str, list[Tensor]] = {}
    for view in track(range(len(SIDES)), "rendering layers"):
        for name, picture in _of_view(scene, cameras, view, errors, albedo_near):
            found.setdefault(name, []).append(picture)
    if not any(bool((picture > BEHIND + 0.05).any()) for picture in found["metal"]):
        del found["metal"]
    return found


def _of_view(
    scene: Scene,
    cameras: Cameras,
    view: int,
    errors: ExpectedErrors | None,
    albedo_near: AlbedoNear | None,
) -> Iterator[tuple[str, Tensor]]:
    surface, wo = surface_of_view(scene, cameras, view, albedo_near)
    width, height = cameras.size(view)
    alpha = surface.opacity.reshape(height, width)

    def grid(values: Tensor) -> Tensor:
        return values.reshape(height, width, -1)

    def plain(values: Tensor) -> Tensor:
        over = alpha[..., None]
        return grid(values).expand(-1, -1, 3) * over + BEHIND * (1 - over)

    yield "render", on_grey(grid(shade_hits(scene, surface, wo)), alpha)
    yield "albedo", plain(linear_to_srgb(surface.albedo))
    yield "roughness", plain(surface.roughness)
    metal = metal_or_none(surface.metallic)
    yield "metal", plain((torch.zeros_like(alpha) if metal is None else metal) * (1 - BEHIND))
    yield "normal", plain(0.5 * surface.normal + 0.5)
    if errors is not None:
        met = (surface.opacity > 0).nonzero()[:, 0]
        error = torch.zeros_like(surface.opacity)
        error[met] = errors.at(surface.position[met], surface.normal[met])[:, 0]
        yield "error", plain(torch.from_numpy(heat(error, ALBEDO_LIMIT)).float())


# The light that was recovered, as one map, whichever model of light it is.


ROWS = 128  # of a map
LOCAL_ROWS = 32  # of the map of a local light, which is smooth
POINTS = 512  # of the surface, that a local light is asked at
AT_ONCE = 64  # of them


@torch.no_grad()
def found_light(scene: Scene, mesh: Mesh) -> tuple[Tensor, str] | None:
    """The scene's environment map [H, 2 H, 3]; of a local light its mean over the surface; and a
    word for people on where it comes from. None: neither.

    What a local light says of a direction is meant for points that face it: there it was learned.
    """
    sky = scene.environment()
    if sky is not None:
        about = "The recovered environment map."
        if scene.flash is not None:
            about += " A flash on the camera also lit the object."
        return scene.exposed(sky.latlong(ROWS)), about
    if not isinstance(scene.light, AbstractLocalLight):
        return None
    about = (
        f"This run has no environment map: its light is local ({scene.cfg.light.kind}) and "
        "differs from point to point. For each direction, the map shows the mean light at the "
        "points that face it, which includes shadows that the object casts on itself."
    )
    if scene.cfg.turntable is not None:
        about += " The map is fixed to the room around the turntable."
    return local_map(scene, mesh), about


def local_map(scene: Scene, mesh: Mesh) -> Tensor:
    """The mean light [LOCAL_ROWS, 2 LOCAL_ROWS, 3] of points, by the cosine at which it arrives."""
    position, normal = surface_points(mesh, POINTS, torch.Generator().manual_seed(0))
    wi = latlong_directions(LOCAL_ROWS).flatten(0, 1)
    total, weight = torch.zeros(len(wi), 3), torch.full((len(wi), 1), 1e-6)
    for index in torch.arange(POINTS).split(AT_ONCE):
        features = scene.coded(scene.field.features_at(position[index]))
        one = torch.ones(len(index))
        surface = Surface(
            position[index], normal[index], features, one[:, None].expand(-1, 3), one, one, one
        )
        radiance = scene.light.incident(surface, wi.expand(len(index), -1, -1))
        # A turning light has no direction that a point faces for good
        facing = torch.ones(len(index), len(wi))
        if scene.cfg.turntable is None:
            facing = (surface.normal @ wi.T).clamp_min(0)
        total += torch.einsum("nd,ndc->dc", facing, radiance)
        weight += facing.sum(0)[:, None]
    return scene.exposed(total / weight).view(LOCAL_ROWS, 2 * LOCAL_ROWS, 3)


def pictures_of(radiance: Tensor) -> list[Tensor]:
    """Map, grey ball and mirror ball [ROWS, ..., 3], sRGB, as bright as shows most of the map."""
    bright = luminance(radiance).quantile(0.9).clamp_min(1e-6)
    return [linear_to_srgb(tile) for tile in map_and_balls(radiance / bright, ROWS)]


# Drawings of a report, as SVG in the text of a page.


RADIUS = 200.0  # of the drawn sphere
ROOM = 34.0  # around it, for words
RINGS = (-60, -30, 0, 30, 60)  # elevations, degrees


def sphere(advice: Advice) -> str:
    """The directions around an object seen from above, the front below: what a photograph from each
    is worth, gaps, photographs that were taken, and the advised ones by number.

    Areas are true: the zenith is in the middle, the nadir the rim, or the lowest direction that was
    weighed.
    """
    lowest = float(elevations(torch.cat([advice.weighed, advice.taken])).min()) - 6.0
    rim = _away(max(lowest, -90.0))

    def at(direction: Tensor) -> list[tuple[float, float]]:
        turned = torch.deg2rad(azimuths(direction) - advice.front)
        away = torch.tensor([_away(e) for e in elevations(direction).tolist()]) / rim * RADIUS
        return list(
            zip((away * turned.sin()).tolist(), (away * turned.cos()).tolist(), strict=True)
        )

    dot = RADIUS * math.sqrt(1.6 / max(len(advice.weighed), 1))
    most = max(float(advice.worth.max()), 2 * advice.least, 1e-9)
    colors = heat(advice.worth[None], most)[0]
    parts = [f'<circle r="{RADIUS:.0f}" class="sky"/>']
    for (x, y), color, gap in zip(at(advice.weighed), colors, advice.gap.tolist(), strict=True):
        ink = "".join(f"{round(255 * c):02x}" for c in color)
        kind = ' class="gap"' if gap else ""
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{dot:.1f}" fill="#{ink}"{kind}/>')
    for up in RINGS:
        ring = _away(up) / rim * RADIUS
        if up >= lowest and ring <= RADIUS:
            kind = "horizon" if up == 0 else "ring"
            parts.append(f'<circle r="{ring:.1f}" class="{kind}"/>')
            parts.append(f'<text y="{-ring - 2:.1f}" class="small">{up}°</text>')
    for (x, y), name in zip(at(advice.taken), advice.names, strict=True):
        title = f"<title>{escape(name)}</title>"
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" class="taken">{title}</circle>')
    for k, (x, y) in enumerate(at(advice.chosen)):
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="10" class="next"/>')
        parts.append(f'<text x="{x:.1f}" y="{y + 4.5:.1f}" class="number">{k + 1}</text>')
    far = RADIUS + 18
    words = ((0, far + 4, "front"), (far, 4, "right"), (0, -far + 6, "back"), (-far, 4, "left"))
    parts += [f'<text x="{x:.0f}" y="{y:.0f}">{word}</text>' for x, y, word in words]
    side = RADIUS + ROOM
    box = f"{-side:.0f} {-side:.0f} {2 * side:.0f} {2 * side:.0f}"
    label = "Directions around the object, seen from above"
    head = f'<svg class="sphere" viewBox="{box}" role="img" aria-label="{label}">'
    return head + "\n".join(parts) + "</svg>"


def _away(elevation: float) -> float:
    """Distance from the middle that keeps areas: 0 at the zenith, 1 at the nadir."""
    return math.sqrt((1 - math.sin(math.radians(elevation))) / 2)
