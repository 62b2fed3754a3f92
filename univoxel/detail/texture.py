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
from concurrent.futures import ThreadPoolExecutor
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
from torch.nn.functional import avg_pool2d, interpolate, normalize

from univoxel.camera import Cameras, pixel_width, project, projection_matrices
from univoxel.color import linear_to_srgb
from univoxel.core import log
from univoxel.core.files import replacing
from univoxel.core.progress_bar import track
from univoxel.core.records import AlbedoNear, Mesh, Surface
from univoxel.data import Photos
from univoxel.data.photos import coverage_of
from univoxel.errors import DataError
from univoxel.ops import VisibilityScene
from univoxel.ops.charts import (
    LINEAR,
    add_photograph_,
    between,
    corner_weights,
    rasterise,
    sampled,
    seen_at_texels,
    unwrap,
)
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
# Weight, relative to that of a view that sees a texel best, of the model's own albedo: where
# next to nothing is seen
PRIOR = 0.02
HELD_OUT, EVERY = 6, 8  # views, at most and one in so many, on which it is tried whether it helps
JUDGED = 8  # one texel in so many is compared with photographs that were held out
AT_ONCE = 1 << 18  # texels: bounds memory


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
        """The texture, and means over squares of 2, 4 and so on of its texels: [T, T, 3] uint8."""
        levels = [self.albedo]
        while len(levels[-1]) > SIZES[0]:
            half = [avg_pool2d(LINEAR[c.int()][None], 2)[0] for c in levels[-1].unbind(-1)]
            levels.append((255 * linear_to_srgb(torch.stack(half, -1))).round().to(torch.uint8))
        return levels

    def at(self, face: Tensor, barycentric: Tensor, footprint: float = 0.0) -> Tensor:
        """Linear albedo [N, 3] at points of faces [N], from means that are no wider than the
        footprint, in world units, of the pixels that ask.

        Args:
            barycentric: [N, 3].
        """
        uv = between(self.uv, self.corners[face], barycentric)
        level = int(math.log2(max(footprint / self.texel, 1)))
        picture = self.levels[min(level, len(self.levels) - 1)]
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

    Two photographs are in memory at a time. Some are held out at first: where texture does not
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
        log.debug("detail: no texture added, because photographs show no more detail than the grid")
        return None
    mesh = surface_of(scene, photos.cameras)
    mesh = simplify(mesh, min(FACES, len(mesh.faces)))
    at = vertices_of(scene, Mesh(mesh.vertices, mesh.faces))
    quality = torch.stack([seen_from(at, photos.cameras, v, voxel) for v in range(len(photos))], 1)
    atlas = _atlas(mesh, size or _size(mesh, quality, photos.downscale))
    baking = _Baking(scene, photos, at, atlas, quality)

    held = list(range(EVERY // 2, len(photos), EVERY))[:HELD_OUT]
    for view, picture in _read(photos, [v for v in range(len(photos)) if v not in held]):
        baking.add(view, picture)
    errors = torch.tensor([baking.errors(*read) for read in _read(photos, held)])  # [H, 2]
    before, after = errors.nanmean(0).tolist() if len(held) else (math.nan, math.nan)
    if not after < before:
        log.info("detail: no texture added, because it would not help to predict other photographs")
        return None
    for view, picture in _read(photos, held):
        baking.add(view, picture)
    gain = -10 * math.log10(after / before)
    log.info(
        "detail: made a texture of %d x %d texels from %d photographs, which improves the "
        "prediction of other photographs by %.1f dB",
        *(atlas.size, atlas.size, len(photos), gain),
    )
    albedo = baking.picture()
    return Detail(mesh.vertices, mesh.faces, atlas.corners, atlas.uv, albedo, 2 * voxel)


def _read(photos: Photos, views: list[int]) -> Iterator[tuple[int, Tensor]]:
    """Views and their photographs at full size, the next of which is read meanwhile."""
    with ThreadPoolExecutor(1) as pool:
        coming = [pool.submit(photos.readers[view], 1) for view in views[:1]]
        for view, following in zip(track(views, "texture"), [*views[1:], None], strict=True):
            picture = coming.pop().result()
            if following is not None:
                coming.append(pool.submit(photos.readers[following], 1))
            yield view, picture


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
    """Charts of a mesh, and which texel lies on which face."""
    _, corners, uv = unwrap(mesh, size)
    texel, face, barycentric = rasterise(uv, corners, size)
    return _Atlas(size, corners, uv, texel.int(), face, barycentric.half())


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
        self.matrix = projection_matrices(photos.cameras)
        self.total = torch.zeros(len(atlas.texel), 3)
        self.weights = torch.zeros(len(atlas.texel))

    def add(self, view: int, picture: Tensor) -> None:
        """Add what a photograph [H, W, 3], as stored, says of the albedo."""
        if (texels := self._texels(view, picture)) is not None:
            add_photograph_(self.total, self.weights, *texels)

    def errors(self, view: int, picture: Tensor) -> tuple[float, float]:
        """Mean squared differences from a photograph, in sRGB, of model and of texture.

        Of one texel in `JUDGED`, for speed.
        """
        if (texels := self._texels(view, picture)) is None:
            return math.nan, math.nan
        face, barycentric, *rest = texels
        some, color, at = seen_at_texels(face[::JUDGED], barycentric[::JUDGED], *rest)
        a, b, albedo, weight = at[:, :3], at[:, 3:6], at[:, 9:12], at[:, 12]
        some = JUDGED * some  # of all texels
        photo, known = linear_to_srgb(color), weight * (self.weights[some] > 0)
        sums = []
        for value in (albedo, self._texture(some, albedo)):
            error = (linear_to_srgb(a * value + b) - photo).square().mean(1)
            sums.append(float((known * error).double().sum() / known.double().sum()))
        return sums[0], sums[1]

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

    def _texels(self, view: int, picture: Tensor) -> tuple[Any, ...] | None:
        """Arguments of `add_photograph_`; None: the photograph shows nothing."""
        weight, faces = self.weight[:, view], self.at.mesh.faces.long()
        shown = self.shown[:, view] & (weight[faces].amax(1) > 0)
        if not shown.any():
            return None
        known = torch.zeros(len(weight), dtype=torch.bool)
        known[faces[shown].reshape(-1)] = True
        values = torch.zeros(len(weight), 13)
        part = at_rays(self.at.surface, known)
        values[known, :6] = torch.cat(split(self.scene, part, self.photos.cameras, view, view), 1)
        values[:, 6:9], values[:, 9:12] = self.at.mesh.vertices, self.at.surface.albedo
        values[:, 12] = weight
        alpha = coverage_of(self.photos.stored(view)[1])
        place = self.atlas.face, self.atlas.barycentric, self.at.mesh.faces, shown
        return *place, values, self.matrix[view], alpha, picture, self.photos.downscale


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
            raise DataError(f"{path}: expected a texture in format {FORMAT}, got {came}; {remedy}")
        if about["checkpoint"] != _fingerprint(Path(run)):
            raise DataError(f"{path}: belongs to another version of {CHECKPOINT}; {remedy}")
        if about["picture"] != _digest(picture):
            raise DataError(f"{picture}: does not belong to {MESH}; {remedy}")
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
