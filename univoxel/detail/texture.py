"""Albedo from full-size photographs, on the mesh of a trained scene.

Training looks at photographs that were shrunk, through a grid that is coarser still. Its surface,
cameras, light and roughness are good enough to take the light out of the photographs as they are:
the model splits what a view shows into albedo * A + B, where A is diffuse light (and what metal
mirrors, which its colour tints) and B the reflection of dielectrics, which has no colour. So

    albedo = sum_v w_v (photo_v - B_v) / A_v / sum_v w_v

at each texel, over the photographs that see it well. A and B vary slowly: they are computed at the
vertices of the mesh.

Sources: Waechter et al. 2014, "Let There Be Color!", for views chosen by how well they see; Debevec
et al. 1998 for blending them by angle, which `univoxel.detail.views` does.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor
from torch.nn.functional import (
    avg_pool2d,
    embedding_bag,
    grid_sample,
    interpolate,
    normalize,
)

from univoxel.camera import Cameras, pixel_width, project
from univoxel.color import linear_to_srgb, luminance, srgb_to_linear
from univoxel.core import log
from univoxel.core.files import replacing
from univoxel.core.records import AlbedoNear, Mesh, Surface
from univoxel.data import Photos
from univoxel.errors import DataError
from univoxel.ops import VisibilityScene
from univoxel.ops.charts import unwrap
from univoxel.output.mesh import nearest_surface, surface_beside, vertex_normals
from univoxel.output.surface import surface_of
from univoxel.output.topology import simplify
from univoxel.render.pipeline import RAYS_AT_ONCE, at_rays, shade
from univoxel.scene import FILE as CHECKPOINT
from univoxel.scene import Scene

FOLDER = "detail"  # in the folder of a run
MESH, PICTURE = "mesh.safetensors", "albedo.png"  # in it
FORMAT = 1  # rises when older files cannot be read any more
# Pixels of a photograph across a voxel, from which on photographs show what the grid cannot hold.
# Rendered scenes of 400 pixels have 2 to 3, photographs of 12 megapixels 15 to 25
PIXELS_OF_VOXEL = 4.0
FACES = 40_000  # of the mesh: within 0.04 voxels of the field, and charts are found in 7 s, not 50
SIZES = 256, 8192  # texels along a side of the texture
PAGE_SIZE = 2048  # the same of a page, which is sent as one file
FILL = 0.6  # of it that charts cover
GRAZING = 0.1  # cosine to a camera, below which it does not count
# Of the weight of the view that sees a vertex best: what has less adds nothing
LEAST = 0.25
CLIPPED, OF_CLIPPED = 0.98, 0.05  # linear; the weight of what is brighter
# Weight, relative to that of a view that sees a texel best, of the model's own albedo: where
# next to nothing is seen
PRIOR = 0.02
HELD_OUT, EVERY = 6, 8  # views, at most and one in so many, on which it is tried whether it helps
AT_ONCE = 1 << 18  # texels: bounds memory
LINEAR = srgb_to_linear(torch.arange(256) / 255)  # of bytes


@dataclass(frozen=True)
class Detail:
    """A mesh with its albedo; a corner of a face has a place in the texture of its own."""

    vertices: Tensor  # [P, 3] float32, world
    faces: Tensor  # [F, 3] int32, rows of `vertices`
    corners: Tensor  # [F, 3] int32, rows of `uv`
    uv: Tensor  # [Q, 2] float32 in [0, 1], v upwards
    albedo: Tensor  # [T, T, 3] uint8 sRGB, row 0 on top, at v = 1
    reach: float  # world units from the mesh within which points of the surface take its albedo

    @cached_property
    def tracer(self) -> VisibilityScene:
        """The mesh, ready for rays."""
        return VisibilityScene(self.vertices, self.faces)

    @cached_property
    def texel(self) -> float:
        """World units along a side of a texel, on average."""
        corner, flat = self.vertices[self.faces.long()], self.uv[self.corners.long()]
        area = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        a, b = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
        covered = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).abs().sum() * len(self.albedo) ** 2
        return float((area.norm(dim=1).sum() / covered.clamp_min(1e-12)).sqrt())

    @cached_property
    def levels(self) -> list[Tensor]:
        """The texture, and means over squares of 2, 4 and so on of its texels: [3, T, T] uint8."""
        levels = [self.albedo.movedim(-1, 0)]
        while levels[-1].shape[-1] > SIZES[0]:
            half = [avg_pool2d(LINEAR[c.int()][None], 2)[0] for c in levels[-1]]
            levels.append((255 * linear_to_srgb(torch.stack(half))).round().to(torch.uint8))
        return levels

    def at(self, face: Tensor, barycentric: Tensor, footprint: float = 0.0) -> Tensor:
        """Linear albedo [N, 3] at points of faces [N], from means that are no wider than the
        footprint, in world units, of the pixels that ask.

        Args:
            barycentric: [N, 3].
        """
        uv = between(self.uv, self.corners[face], barycentric)
        level = int(math.log2(max(footprint / self.texel, 1)))
        picture = self.levels[min(level, len(self.levels) - 1)].movedim(0, -1)
        place = torch.stack([uv[:, 0], 1 - uv[:, 1]], 1) * len(picture)
        return sampled(picture, place)

    def near(self, points: Tensor, normals: Tensor, albedo: Tensor, footprint: float) -> Tensor:
        """Linear albedo [N, 3] of points of the surface; `albedo` where the mesh is not near.

        The mesh is met along the normal, from outside.

        Args:
            points, normals: [N, 3] world; unit.
            albedo: [N, 3] that the field has there.
            footprint: as in `at`.
        """
        out = albedo.clone()
        for some in torch.arange(len(points)).split(AT_ONCE):
            start = points[some] + self.reach * normals[some]
            hit = self.tracer.closest_hit(start, -normals[some], 0.0, 2 * self.reach)
            met = hit.face >= 0
            found = self.at(hit.face[met], corner_weights(hit.barycentric[met]), footprint)
            out[some[met]] = found
        return out


def corner_weights(barycentric: Tensor) -> Tensor:
    """(u, v) [N, 2] of `ops.Hit` as weights of the three corners [N, 3]."""
    return torch.cat([1 - barycentric.sum(1, keepdim=True), barycentric], 1)


def linear(picture: Tensor) -> Tensor:
    """A stored picture [..., 3], uint8 sRGB or float32 linear, as the latter."""
    return LINEAR[picture.int()] if picture.dtype == torch.uint8 else picture


def sampled(picture: Tensor, place: Tensor) -> Tensor:
    """Linear colours [N, 3] of a picture at places, bilinear in linear light.

    Args:
        picture: [H, W, 3] uint8 sRGB, or float32 linear.
        place: [N, 2] x to the right and y down, in pixels; a pixel's centre is at a half.
    """
    height, width = picture.shape[:2]
    if not len(place):
        return torch.zeros(0, 3)
    # What is asked for, with a pixel around it
    low = (place.amin(0).floor().int() - 1).tolist()
    high = (place.amax(0).ceil().int() + 1).tolist()
    x, y = (min(max(n, 0), size - 1) for n, size in zip(low, (width, height), strict=True))
    part = picture[y : max(high[1], y + 1), x : max(high[0], x + 1)]
    part = linear(part)
    size = torch.tensor([part.shape[1], part.shape[0]])
    at = 2 * (place - torch.tensor([x, y])) / size - 1
    planes = part.movedim(-1, 0)[None]
    found = grid_sample(planes, at[None, None], padding_mode="border", align_corners=False)
    return found[0, :, 0].T


def between(values: Tensor, corner: Tensor, weights: Tensor) -> Tensor:
    """Values [P, C] of vertices at points of faces, [N, C].

    Args:
        corner: [N, 3] int32 rows of `values`.
        weights: [N, 3] of the corners.
    """
    return embedding_bag(corner, values, per_sample_weights=weights, mode="sum")


# What cameras see of a mesh, and how the model explains it.


@dataclass(frozen=True)
class Vertices:
    """The vertices of a mesh near the surface of a scene, with what the field has there."""

    mesh: Mesh
    normals: Tensor  # [P, 3] unit, of the mesh
    surface: Surface  # P points of the field's surface
    tracer: VisibilityScene


@torch.no_grad()
def vertices_of(scene: Scene, mesh: Mesh) -> Vertices:
    """The vertices of a mesh, and the field's surface beside them."""
    x, at = nearest_surface(scene.field, mesh.vertices, surface_beside(scene.field, mesh))
    albedo, roughness, metallic = scene.material(at.features)
    surface = Surface(
        position=x,
        normal=normalize(at.gradient, dim=1, eps=1e-6),
        features=at.features,
        albedo=albedo,
        roughness=roughness,
        opacity=torch.ones(len(x)),
        depth=torch.zeros(len(x)),
        metallic=metallic,
    )
    tracer = VisibilityScene(mesh.vertices, mesh.faces)
    return Vertices(mesh, vertex_normals(mesh), surface, tracer)


def seen_from(at: Vertices, cameras: Cameras, view: int, offset: float) -> Tensor:
    """How well a view sees each vertex, [P]: pixels on a square of world units there, 0 where it
    is hidden, or at a border beyond which something is.

    Args:
        offset: world units that rays start off the surface.
    """
    vertices, faces = at.mesh.vertices, at.mesh.faces.long()
    away = cameras.camera_to_world[view, :, 3] - vertices
    distance = away.norm(dim=1, keepdim=True)
    towards = away / distance.clamp_min(1e-12)
    pixel, depth = project(cameras, view, vertices)
    cosine = (at.normals * towards).sum(1)
    inside = ((pixel > 0) & (pixel < torch.tensor(cameras.size(view)))).all(1) & (depth > 0)
    seen = inside & (cosine > GRAZING)
    asked = seen.nonzero()[:, 0]
    start = vertices[asked] + 0.5 * offset * (at.normals[asked] + towards[asked])
    reach = float(distance.max())
    seen[asked] = ~at.tracer.occluded(start, towards[asked], 0.0, reach)
    border = faces[~seen[faces].all(1)].reshape(-1)
    seen[border] = False
    per_unit = cameras.focal[view].mean() / depth.clamp_min(1e-12)
    return torch.where(seen, cosine * per_unit.square(), 0.0)


@torch.no_grad()
def split(
    scene: Scene, surface: Surface, cameras: Cameras, view: int, photo: int | None
) -> tuple[Tensor, Tensor]:
    """A and B [N, 3], linear: a view of the surface is albedo * A + B.

    Args:
        photo: as `view` of `univoxel.render.pipeline.shade`.
    """
    away = cameras.camera_to_world[view, :, 3] - surface.position
    distance = away.norm(dim=1)
    surface, wo = replace(surface, depth=distance), away / distance[:, None].clamp_min(1e-12)
    parts = []
    for some in torch.arange(len(wo)).split(RAYS_AT_ONCE):
        part = at_rays(surface, some)
        black = replace(part, albedo=torch.zeros_like(part.albedo))
        a, b = (shade(scene, s, wo[some], view=photo) for s in (part, black))
        parts.append(torch.stack([((a - b) / part.albedo.clamp_min(1e-3)).clamp_min(0), b]))
    both = torch.cat(parts, 1) if parts else surface.position.new_zeros(2, 0, 3)
    return both[0], both[1]


# Making it.


@torch.no_grad()
def make_detail(scene: Scene, photos: Photos, size: int | None = None) -> Detail | None:
    """The detail that photographs have beyond the model; None, with a line, where they have none.

    One photograph is in memory at a time. Some are held out at first: where texture does not
    predict them better than the model's own albedo does, there is no detail.

    Args:
        photos: that were trained on, as they were; their files are read again.
        size: texels along a side of the texture; None: what photographs resolve, a power of 2.

    Raises:
        DataError: a photograph cannot be read any more.
        ValueError: the scene has no surface.
    """
    photos = scene.registered(photos)
    voxel, middle = scene.field.voxel_size, torch.stack(scene.field.bounds()).mean(0)
    pixel = pixel_width(photos.cameras, middle) / photos.downscale
    if not photos.readers or voxel < PIXELS_OF_VOXEL * pixel:
        log.debug("detail: no texture added, because photographs are no finer than the grid")
        return None
    mesh = surface_of(scene, photos.cameras)
    mesh = simplify(mesh, min(FACES, len(mesh.faces)))
    at = vertices_of(scene, Mesh(mesh.vertices, mesh.faces))
    quality = torch.stack([seen_from(at, photos.cameras, v, voxel) for v in range(len(photos))], 1)
    atlas = _atlas(mesh, size or _size(mesh, quality, photos.downscale))
    baking = _Baking(scene, photos, at, atlas, quality)

    held = list(range(EVERY // 2, len(photos), EVERY))[:HELD_OUT]
    for view in range(len(photos)):
        if view not in held:
            baking.add(view)
    errors = torch.tensor([baking.errors(view) for view in held])  # [H, 2]
    before, after = errors.nanmean(0).tolist() if len(held) else (math.nan, math.nan)
    if not after < before:
        log.info("detail: no texture added, because it would not predict photographs better")
        return None
    for view in held:
        baking.add(view)
    gain = -10 * math.log10(after / before)
    log.info(
        "detail: a texture of %d x %d from %d photographs, which predicts others %.1f dB better",
        *(atlas.size, atlas.size, len(photos), gain),
    )
    albedo = baking.picture()
    return Detail(mesh.vertices, mesh.faces, atlas.corners, atlas.uv, albedo, 2 * voxel)


def _size(mesh: Mesh, quality: Tensor, downscale: int) -> int:
    """The power of 2 below the texels that photographs resolve on the mesh."""
    corner = mesh.vertices[mesh.faces.long()]
    area = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    best = quality.amax(1)
    density = float(best[best > 0].median()) if bool((best > 0).any()) else 0.0
    texels = 0.5 * float(area.norm(dim=1).sum()) * density * downscale**2 / FILL
    low, high = SIZES
    return min(max(1 << int(0.5 * math.log2(max(texels, 1.0))), low), high)


@dataclass(frozen=True)
class _Atlas:
    size: int
    corners: Tensor  # [F, 3] int32
    uv: Tensor  # [Q, 2]
    texel: Tensor  # [K] int32 those in charts, row * size + column
    face: Tensor  # [K] int32
    barycentric: Tensor  # [K, 2] float16, as in `ops.Hit`


def _atlas(mesh: Mesh, size: int) -> _Atlas:
    """Charts of a mesh, and which texel lies on which face: rays through the flat charts tell."""
    _, corners, uv = unwrap(mesh, size)
    flat = torch.cat([uv, torch.zeros(len(uv), 1)], 1)
    charts = VisibilityScene(flat, corners)
    found, rows = [], max(1, AT_ONCE // size)
    for top in range(0, size, rows):
        row, column = torch.meshgrid(
            torch.arange(top, min(top + rows, size)), torch.arange(size), indexing="ij"
        )
        place = [(column + 0.5) / size, 1 - (row + 0.5) / size, torch.ones(row.shape)]
        start = torch.stack(place, -1).reshape(-1, 3)
        hit = charts.closest_hit(start, torch.tensor([0.0, 0.0, -1.0]).expand_as(start))
        met = (hit.face >= 0).nonzero()[:, 0]
        texel = (met + top * size).int()
        found.append((texel, hit.face[met].int(), hit.barycentric[met].half()))
    texel, face, barycentric = (torch.cat(part) for part in zip(*found, strict=True))
    return _Atlas(size, corners, uv, texel, face, barycentric)


class _Baking:
    """Sums over photographs at the texels of an atlas."""

    def __init__(
        self, scene: Scene, photos: Photos, at: Vertices, atlas: _Atlas, quality: Tensor
    ) -> None:
        """For [P, V] of `seen_from`."""
        self.scene, self.photos, self.at, self.atlas = scene, photos, at, atlas
        best = quality.amax(1, keepdim=True).clamp_min(1e-30)
        self.weight = (quality / best - LEAST).clamp_min(0)
        self.shown = (quality[at.mesh.faces.long()] > 0).all(1)  # [F, V] without hidden corners
        self.total = torch.zeros(len(atlas.texel), 3)
        self.weights = torch.zeros(len(atlas.texel))

    def add(self, view: int) -> None:
        """Add what a photograph says of the albedo."""
        for some, color, a, b, albedo, weight in self._observed(view):
            trusted = (
                weight * luminance(a) * (color.amax(1) < CLIPPED).float().clamp_min(OF_CLIPPED)
            )
            model = a * albedo
            own = model / (model + b).clamp_min(1e-6)  # share that is no reflection
            trusted *= (luminance(model) / luminance(model + b).clamp_min(1e-6)).square()
            value = ((color - b) / a.clamp_min(1e-3)).clamp(0, 1)
            # What is left of a channel that reflections hide is a tint that nothing has: brightness
            # is the photograph's then, and colour the model's
            even = (own.amin(1) / own.amax(1).clamp_min(1e-6)).square()[:, None]
            bright = luminance(value) / luminance(albedo).clamp_min(1e-4)
            value = torch.lerp((albedo * bright[:, None]).clamp(0, 1), value, even)
            self.total.index_add_(0, some, trusted[:, None] * value)
            self.weights.index_add_(0, some, trusted)

    def errors(self, view: int) -> tuple[float, float]:
        """Mean squared differences from a photograph, in sRGB, of model and of texture."""
        sums = torch.zeros(3, dtype=torch.float64)
        for some, color, a, b, albedo, weight in self._observed(view):
            photo, known = linear_to_srgb(color), weight * (self.weights[some] > 0)
            for k, value in enumerate((albedo, self._texture(some, albedo))):
                error = (linear_to_srgb(a * value + b) - photo).square().mean(1)
                sums[k] += (known * error).sum()
            sums[2] += known.sum()
        model, texture = (sums[:2] / sums[2]).tolist()
        return model, texture

    def picture(self) -> Tensor:
        """The texture, with its background filled from beside it: [T, T, 3] uint8 sRGB."""
        size = self.atlas.size
        picture, known = torch.zeros(size * size, 3, dtype=torch.uint8), torch.zeros(size * size)
        for some in torch.arange(len(self.atlas.texel)).split(AT_ONCE):
            albedo = self._between(self.at.surface.albedo, some)
            value = linear_to_srgb(self._texture(some, albedo))
            texel = self.atlas.texel[some].long()
            picture[texel], known[texel] = (255 * value).round().to(torch.uint8), 1.0
        self.total = self.weights = torch.empty(0)
        return _filled(picture.view(size, size, 3), known.view(size, size))

    def _texture(self, some: Tensor, albedo: Tensor) -> Tensor:
        """Albedo [N, 3] of some texels so far, near to the model's where little is known."""
        prior = PRIOR * self.weights.max()
        weight = self.weights[some, None]
        return (self.total[some] + prior * albedo) / (weight + prior).clamp_min(1e-12)

    def _between(self, values: Tensor, some: Tensor) -> Tensor:
        """Values [P, C] of vertices at texels [N]: [N, C]."""
        weights = corner_weights(self.atlas.barycentric[some].float())
        return between(values, self.at.mesh.faces[self.atlas.face[some]], weights)

    def _observed(self, view: int) -> Iterator[tuple[Tensor, ...]]:
        """Texels [N] that a photograph shows, its linear colours [N, 3], A, B and the model's
        albedo, and weights [N], in parts."""
        weight, faces = self.weight[:, view], self.at.mesh.faces.long()
        shown = self.shown[:, view] & (weight[faces].amax(1) > 0)
        if not shown.any():
            return
        cameras, factor = self.photos.cameras, self.photos.downscale
        known = torch.zeros(len(weight), dtype=torch.bool)
        known[faces[shown].reshape(-1)] = True
        values = torch.zeros(len(weight), 13)  # A, B, weight, place, albedo
        part = at_rays(self.at.surface, known)
        values[known, :6] = torch.cat(split(self.scene, part, cameras, view, view), 1)
        values[:, 6], values[:, 7:10] = weight, self.at.mesh.vertices
        values[:, 10:] = self.at.surface.albedo
        pixel, _ = project(cameras, view, self.at.mesh.vertices[known])
        low, high = ((factor * x).int() for x in (pixel.amin(0).floor(), pixel.amax(0).ceil()))
        left, top = low.sub(2).clamp_min(0).tolist()
        right, bottom = high.add(2).tolist()
        picture = linear(self.photos.readers[view](1)[top:bottom, left:right])
        alpha = self.photos.stored(view)[1]
        alpha = (alpha.float() / (255 if alpha.dtype == torch.uint8 else 1))[None, None]
        size = torch.tensor(cameras.size(view))
        some = shown[self.atlas.face].nonzero()[:, 0]
        for index in some.split(AT_ONCE):
            at = self._between(values, index)
            pixel, _ = project(cameras, view, at[:, 7:10])
            place = (2 * pixel / size - 1)[None, None]
            cover = grid_sample(alpha, place, align_corners=False)[0, 0, 0]
            kept = ((at[:, 6] > 0) & (cover > 0.95)).nonzero()[:, 0]
            at = at[kept]
            color = sampled(picture, factor * pixel[kept] - torch.tensor([left, top]))
            yield index[kept], color, at[:, :3], at[:, 3:6], at[:, 10:], at[:, 6]


def _filled(picture: Tensor, known: Tensor) -> Tensor:
    """A picture [T, T, 3] uint8 whose unknown texels are means of known ones beside them.

    Source: Gortler et al. 1996, "The Lumigraph", pull and push.
    """
    for channel in picture.unbind(-1):
        values, weights = [(channel.float() * known)[None, None]], [known[None, None]]
        while values[-1].shape[-1] > 1:
            values.append(avg_pool2d(values[-1], 2))
            weights.append(avg_pool2d(weights[-1], 2))
        up = values[-1] / weights[-1].clamp_min(1e-12)
        for value, weight in zip(values[-2::-1], weights[-2::-1], strict=True):
            up = interpolate(up, scale_factor=2, mode="nearest")
            up = torch.where(weight > 0, value / weight.clamp_min(1e-12), up)
        channel.copy_(torch.where(known > 0, channel.float(), up[0, 0]).round())
    return picture


# Its files.


def save_detail(detail: Detail, run: Path) -> None:
    """Write detail beside the checkpoint that it was made for, whole or not at all.

    Raises:
        OSError: it cannot be written.
    """
    folder = run / FOLDER
    folder.mkdir(exist_ok=True)
    (folder / MESH).unlink(missing_ok=True)  # it goes first and comes last: what it says holds
    with replacing(folder / PICTURE) as temporary:
        Image.fromarray(detail.albedo.numpy()).save(temporary, format="PNG", compress_level=1)
    tensors = {name: getattr(detail, name) for name in ("vertices", "faces", "corners", "uv")}
    about = {"format": FORMAT, "reach": detail.reach, "checkpoint": _fingerprint(run)}
    about["picture"] = _digest(folder / PICTURE)
    with replacing(folder / MESH) as temporary:
        save_file(tensors, temporary, {"univoxel": json.dumps(about)})


def albedo_near(run: str | Path) -> AlbedoNear | None:
    """What gives the albedo of a run where it has detail; errors as in `load_detail`."""
    detail = load_detail(run)
    return None if detail is None else detail.near


def page_options(run: str | Path) -> dict[str, Any]:
    """Fields of `univoxel.output.page.PageOptions` that show the detail of a run, if it has any;
    errors as in `load_detail`."""
    near = albedo_near(run)
    return {} if near is None else {"albedo_near": near, "texture_size": PAGE_SIZE}


def load_detail(run: str | Path) -> Detail | None:
    """The detail of a run; None: it has none.

    Raises:
        DataError: it was made for another checkpoint, by another version, or is damaged.
    """
    path, picture = Path(run) / FOLDER / MESH, Path(run) / FOLDER / PICTURE
    if not path.is_file():
        return None
    remedy = f"make it again with `univoxel detail {run}`, or remove {path.parent}"
    try:
        with safe_open(path, "pt") as file:
            about = json.loads((file.metadata() or {}).get("univoxel", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}
        if about.get("format") != FORMAT:
            came = f"{about.get('format')!r:.40}"
            raise DataError(f"{path}: expected detail in format {FORMAT}, got {came}; {remedy}")
        if about["checkpoint"] != _fingerprint(Path(run)):
            raise DataError(f"{path}: made for another checkpoint than {CHECKPOINT}; {remedy}")
        if about["picture"] != _digest(picture):
            raise DataError(f"{picture}: not the file that was written with {MESH}; {remedy}")
        albedo = torch.from_numpy(np.array(Image.open(picture).convert("RGB")))
        detail = Detail(**tensors, albedo=albedo, reach=float(about["reach"]))
        _check(detail)
        return detail
    except (OSError, SafetensorError, ValueError, KeyError, TypeError, AttributeError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"{path}: damaged: {error}; {remedy}") from error


def _check(detail: Detail) -> None:
    """Refuse tensors that do not fit one another."""
    faces, corners = detail.faces, detail.corners
    for rows, index in ((detail.vertices, faces), (detail.uv, corners)):
        within = len(index) and 0 <= int(index.min()) <= int(index.max()) < len(rows)
        if index.shape != (len(faces), 3) or not within or not bool(rows.isfinite().all()):
            raise ValueError("its faces and vertices do not match")
    if not 0 < detail.reach < math.inf:
        raise ValueError(f"reach must be above 0, got {detail.reach}")


def _fingerprint(run: Path) -> str:
    """Of the checkpoint that a run has now."""
    return _digest(run / CHECKPOINT)


def _digest(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while part := file.read(1 << 20):
            digest.update(part)
    return digest.hexdigest()
