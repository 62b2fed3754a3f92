"""Novel views at any size: the texture under the model's light, plus residuals of photographs
nearby; and the share of the photographs' detail that they show.

A view is albedo * A + B, as in `univoxel.detail.texture`, with the texture for albedo. What the
model of light cannot say, such as how single fibres glitter, the nearest photographs do: each pixel
is multiplied by (photo / prediction) of those, by how near their directions are. With
no photograph near, that is 1.

Source: Buehler et al. 2001, "Unstructured Lumigraph Rendering", for the weights.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from scipy.ndimage import binary_erosion, gaussian_filter
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from univoxel.camera import Cameras, pixel_rays, pixel_width, project, resize
from univoxel.color import linear_to_srgb
from univoxel.core import log
from univoxel.core.progress_bar import track
from univoxel.core.records import Mesh
from univoxel.data import Photos
from univoxel.data.images import write_exr
from univoxel.data.photos import coverage_of
from univoxel.detail.texture import (
    Detail,
    Vertices,
    load_detail,
    seen_from,
    split,
    vertices_of,
)
from univoxel.errors import UserError
from univoxel.evaluation.measures import fit_light_, render_layers
from univoxel.ops import native
from univoxel.ops.charts import between, corner_weights, linear, sampled
from univoxel.render.metrics import ssim
from univoxel.render.pipeline import at_rays
from univoxel.run import photos_of
from univoxel.scene import Scene

NEAREST = 6  # photographs that a view is put right by
# Weights fall to 1/e within 7 degrees; on captures photographs are some 10 degrees apart
NARROW = 120.0
NONE_NEAR = 1e-3  # weight, of 1 for a photograph of the same direction, that nothing is changed
DARK = 0.01  # linear, added to both sides of ratios
MOST = 10.0  # times that a ratio makes a pixel brighter or darker
AT_ONCE = 1 << 18  # pixels: bounds memory
SAME = 0.1  # by which sizes of pixels may differ
KEPT = 8  # photographs in memory, 36 MB each where they have 12 megapixels


@dataclass(frozen=True)
class _Photo:
    """What one photograph says."""

    picture: Tensor  # [H, W, 3] as stored, or linear
    scale: float  # its size over that of the file, at most 1
    values: Tensor  # [P, 7] A, B and weight at the vertices
    shown: Tensor  # [F] bool: faces none of whose corners are hidden


class DetailedViews:
    """Renders a scene with its detail."""

    def __init__(self, scene: Scene, detail: Detail, photos: Photos | None = None) -> None:
        """With the photographs that were trained on, or None: views are the model's only."""
        self.scene: Scene = scene
        self.detail: Detail = detail
        self.at: Vertices = vertices_of(scene, Mesh(detail.vertices, detail.faces))
        self.photos: Photos | None = None
        self._one_light = scene.views is None
        if photos is not None and photos.readers:
            self.photos = scene.registered(photos)
        self._kept: OrderedDict[int, _Photo] = OrderedDict()
        if self.photos is not None:
            self.full: Cameras = full_size(self.photos)
            self._scale = 1.0  # of the photographs that are kept

    @torch.no_grad()
    def render(
        self, cameras: Cameras, view: int, coarse: Tensor, opacity: Tensor
    ) -> tuple[Tensor, Tensor]:
        """A view, premultiplied and linear [H, W, 3], and the same by the model only.

        Args:
            cameras: with pictures of the size that is asked for.
            coarse: [h, w, 3] render of the same view in any size, premultiplied; it shows where the
                mesh is not met.
            opacity: [h, w] of that.
        """
        width, height = cameras.size(view)
        aided = _enlarged(torch.cat([coarse, opacity[..., None]], -1), width, height)
        cover = aided[..., 3:].clamp(0, 1)
        aided = aided[..., :3].clamp_min(0)
        alone = aided.clone()
        values = torch.cat(split(self.scene, self.at.surface, cameras, view, None), 1)
        near = self._near(cameras.camera_to_world[view, :, 3])
        if near:
            self._shrink_to(cameras, view)
        rows = max(1, AT_ONCE // width)
        for top in range(0, height, rows):
            band = slice(top, min(top + rows, height))
            row, column = torch.meshgrid(
                torch.arange(band.start, band.stop), torch.arange(width), indexing="ij"
            )
            there = (cover[band, :, 0] > 0).reshape(-1).nonzero()[:, 0]
            pixel = torch.stack([column, row], -1).reshape(-1, 2)[there] + 0.5
            rays = pixel_rays(cameras, torch.tensor(view), pixel)
            hit = self.detail.tracer.closest_hit(rays.origin.contiguous(), rays.direction)
            met = hit.face >= 0
            there, face = there[met], hit.face[met]
            if not len(face):
                continue
            weights = corner_weights(hit.barycentric[met])
            depth = hit.t[met].median()
            footprint = float(depth / cameras.focal[view].mean())
            albedo = self.detail.at(face, weights, footprint)
            corner = self.detail.faces[face]
            light = between(values, corner, weights)
            model = light[:, :3] * albedo + light[:, 3:]
            place = between(self.detail.vertices, corner, weights)
            change = self._change(near, face, weights, place, rays.direction[met], albedo)
            over = cover[band].reshape(-1, 1)[there]
            alone[band].view(-1, 3)[there] = model * over
            put_right = (model + DARK) * change.exp() - DARK
            aided[band].view(-1, 3)[there] = put_right.clamp_min(0) * over
        return aided, alone

    def _near(self, eye: Tensor) -> list[int]:
        """The photographs whose directions from the object are nearest."""
        if self.photos is None:
            return []
        middle = self.detail.vertices.mean(0)
        away = normalize(self.photos.cameras.camera_to_world[:, :, 3] - middle, dim=1)
        return (away @ normalize(eye - middle, dim=0)).argsort(descending=True)[:NEAREST].tolist()

    def _shrink_to(self, cameras: Cameras, view: int) -> None:
        """Keep photographs no finer than a view's pixels: they would alias."""
        middle = self.detail.vertices.mean(0)
        one = pixel_width(cameras.of(torch.tensor([view])), middle)
        scale = min(1.0, pixel_width(self.full, middle) / one)
        if abs(scale / self._scale - 1) > SAME:
            self._kept.clear()
            self._scale = scale

    def _change(
        self,
        near: list[int],
        face: Tensor,
        weights: Tensor,
        place: Tensor,
        direction: Tensor,
        albedo: Tensor,
    ) -> Tensor:
        """Logarithms [N, 3] of what pixels are multiplied by."""
        corner = self.detail.faces[face]
        total, whole = torch.zeros(len(place), 3), torch.full((len(place), 1), NONE_NEAR)
        for view in near:
            photo = self._photo(view)
            at = between(photo.values, corner, weights)
            seen = photo.shown[face].nonzero()[:, 0]
            at, some = at[seen], place[seen]
            towards = normalize(self.full.camera_to_world[view, :, 3] - some, dim=1)
            cosine = -(towards * direction[seen]).sum(1)
            weight = (at[:, 6] * (NARROW * (cosine - 1)).exp())[:, None]
            pixel = project(self.full, view, some)[0]
            color = sampled(photo.picture, photo.scale * pixel)
            ratio = (color + DARK) / (at[:, :3] * albedo[seen] + at[:, 3:6] + DARK)
            # Where the surface is off, or a part was moved, it may show what is behind the object
            weight = weight * self._shown(view, pixel)[:, None]
            total.index_add_(0, seen, weight * ratio.clamp(1 / MOST, MOST).log())
            whole.index_add_(0, seen, weight)
        return total / whole

    def _shown(self, view: int, pixel: Tensor) -> Tensor:
        """Whether a photograph's mask has the object at points of its full size [N, 2]: [N]."""
        assert self.photos is not None
        _, alpha = self.photos.stored(view)
        height, width = alpha.shape
        column, row = (pixel / self.photos.downscale).long().unbind(1)
        at = alpha[row.clamp(0, height - 1), column.clamp(0, width - 1)]
        return coverage_of(at)

    def _photo(self, view: int) -> _Photo:
        """A photograph, and A, B and weights of the vertices in it."""
        assert self.photos is not None
        if view not in self._kept:
            while len(self._kept) >= KEPT:
                self._kept.popitem(last=False)
            cameras = self.photos.cameras
            quality = seen_from(self.at, cameras, view, self.scene.field.voxel_size)
            values = torch.zeros(len(quality), 7)
            seen = quality > 0
            part = at_rays(self.at.surface, seen)
            shown = self.scene.views
            if self._one_light:  # a light that was fitted to a test view is not the photographs'
                self.scene.views = None
            try:
                values[seen, :6] = torch.cat(split(self.scene, part, cameras, view, view), 1)
            finally:
                self.scene.views = shown
            values[:, 6] = quality / quality.max().clamp_min(1e-30)
            picture, scale = self.photos.readers[view](1), 1.0
            if self._scale < 1 - SAME:
                scale = self._scale
                picture = _shrunk(picture, scale)
            shown = seen[self.detail.faces.long()].all(1)
            self._kept[view] = _Photo(picture, scale, values, shown)
        self._kept.move_to_end(view)
        return self._kept[view]


def detailed_views(scene: Scene, run: Path, data: Path | None) -> DetailedViews | None:
    """What renders the views of a run with its detail; None: it has none.

    Args:
        data: as in `univoxel.run.photos_of`. Where it has no photographs, or others, views are the
            model's.

    Raises:
        DataError: as `load_detail`.
    """
    detail = load_detail(run)
    if detail is None:
        return None
    try:
        train = photos_of(run, data, "train")
        if scene.cfg.views and list(scene.cfg.views) != train.names:
            raise UserError(f"{train.folder} has other photographs than the run was trained on")
        return DetailedViews(scene, detail, train)
    except (UserError, OSError) as error:
        log.info("novel views use only the model, not the training photographs: %s", error)
        return DetailedViews(scene, detail)


def full_size(photos: Photos) -> Cameras:
    """The cameras of photographs at the size of their files, but for the rows and columns that are
    cut off to the right and below because `Photos.downscale` does not divide them."""
    return resize(photos.cameras, photos.downscale * photos.cameras.width)


def _shrunk(picture: Tensor, scale: float) -> Tensor:
    """A stored picture [H, W, 3] of `scale` times the size, < 1, linear where it was not."""
    planes = linear(picture).movedim(-1, 0)
    small = interpolate(planes[None], scale_factor=scale, mode="bilinear", antialias=True)
    return small[0].movedim(0, -1).contiguous()


def _enlarged(picture: Tensor, width: int, height: int) -> Tensor:
    """A picture [h, w, C] in another size, bilinear."""
    planes = picture.movedim(-1, 0)[None]
    return interpolate(planes, (height, width), mode="bilinear")[0].movedim(0, -1)


# How much of the detail of photographs a picture has.


OCTAVES = 6
FINEST = 0.85  # sigma in pixels of the Gaussian that the finest octave is what is left of
EDGE = 0.004  # of the width, that the silhouette is made smaller by


@dataclass(frozen=True)
class Likeness:
    """A picture beside its photograph, over the object."""

    psnr: float  # dB, sRGB, after a gain per channel
    dot: np.ndarray  # [OCTAVES] sums over pixels: of photograph times picture
    own: np.ndarray  # of the picture's square
    photo: np.ndarray  # of the photograph's square


def likenesses(pictures: Sequence[Tensor], photo: Tensor, cover: Tensor) -> list[Likeness]:
    """How like pictures [H, W, 3] are to a photograph, all linear, where `cover` [H, W] is the
    object; empty if too little of it is.

    The object is made smaller by EDGE, so that its silhouette does not count. Octave k is the
    difference of the grey values under Gaussians of 0.85 2^(k-1) and 0.85 2^k pixels: periods of
    about 2^(k+1) to 2^(k+2) pixels.
    """
    edge = max(2, round(EDGE * cover.shape[1]))
    inside = np.asarray(binary_erosion((cover > 0.99).numpy(), iterations=edge), bool)
    if inside.sum() < 1000:
        return []
    rows, columns = (np.flatnonzero(inside.any(axis)) for axis in (1, 0))
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    inside = inside[box]
    truth, *others = (linear_to_srgb(x[box]).numpy() for x in (photo, *pictures))
    made, quality = [], []
    for other in others:
        gain = (truth * other)[inside].sum(0) / np.maximum((other[inside] ** 2).sum(0), 1e-9)
        made.append(np.where(inside[..., None], other, truth) * gain.astype(np.float32))
        error = float(((truth - made[-1])[inside] ** 2).mean())
        quality.append(-10 * math.log10(max(error, 1e-12)))
    sums = np.zeros((len(made), 3, OCTAVES))
    before = grey = [x @ np.array([0.299, 0.587, 0.114], np.float32) for x in (truth, *made)]
    with ThreadPoolExecutor(native.threads()) as pool:
        for k in range(OCTAVES):
            after = list(pool.map(gaussian_filter, grey, repeat(FINEST * 2**k)))
            band, *own = (
                (b - a)[inside].astype(np.float64) for b, a in zip(before, after, strict=True)
            )
            for sum_, one in zip(sums, own, strict=True):
                sum_[:, k] = (band * one).sum(), (one * one).sum(), (band * band).sum()
            before = after
    return [Likeness(psnr, *sum_) for psnr, sum_ in zip(quality, sums, strict=True)]


def coherence(found: list[Likeness]) -> list[float]:
    """Cosine between pictures and photographs, octave by octave, the finest first, over all."""
    dot, own, photo = np.sum([(x.dot, x.own, x.photo) for x in found], 0)
    return (dot / np.sqrt(np.maximum(own * photo, 1e-12))).tolist()


@torch.no_grad()
def measure_full_size(
    scene: Scene,
    views: DetailedViews | None,
    test: Photos,
    save: Path | None = None,
    fit_light: bool = False,
) -> dict[str, float | None]:
    """Novel views at the size of their photographs' files against these, by `FULL_MEASURES`.

    Args:
        views: None: the model's views, enlarged.
        fit_light: each is rendered in the light that fits its photograph.
        save: folder for NAME_full.exr, the view as half floats: rgb.*, linear on black, and alpha.
    """
    found: tuple[list[Likeness], list[Likeness]] = ([], [])
    similar: list[float] = []
    cameras = full_size(test)
    for view in track(range(len(test) if test.readers else 0), "full size"):
        width, height = cameras.size(view)
        photo = linear(test.readers[view](1)[:height, :width])
        if fit_light:
            fit_light_(scene, test, view, views and views.detail.near)
        layers = render_layers(scene, test.cameras, view)
        cover = _enlarged(test.picture(view)[1][..., None], width, height)[..., 0]
        alpha = _enlarged(layers.alpha[..., None], width, height)[..., 0]
        if views is None:
            aided = alone = _enlarged(layers.rgb, width, height)
        else:
            aided, alone = views.render(cameras, view, layers.rgb, layers.alpha)
        both = torch.minimum(cover, alpha)
        like = likenesses((aided, alone), photo, both)  # none, if little of the object is seen
        for measured, one in zip(found, like, strict=False):
            measured.append(one)
        similar.append(ssim(linear_to_srgb(aided), linear_to_srgb(photo * cover[..., None])))
        if save:
            channels = {f"rgb.{c}": aided[..., k] for k, c in enumerate("RGB")}
            write_exr(save / f"{test.names[view]}_full.exr", channels | {"alpha": alpha})
    result: dict[str, float | None] = dict.fromkeys(FULL_MEASURES)
    if similar:
        result["full_ssim"] = fmean(similar)
    for prefix, measured in zip(("full", "full_model"), found, strict=True):
        if measured:
            result[f"{prefix}_psnr"] = fmean(x.psnr for x in measured)
            for k, value in enumerate(coherence(measured)):
                result[f"{prefix}_coherence_{k + 1}"] = value
    return result


# By key: what the table says of it
FULL_MEASURES = {
    "full_psnr": "full size: PSNR of the object in novel views, dB, after scaling each channel",
    "full_ssim": "full size: SSIM",
    **{
        f"full_coherence_{k + 1}": f"full size: coherence in octave {k + 1}" for k in range(OCTAVES)
    },
    "full_model_psnr": "full size, model only: PSNR, dB",
    **{
        f"full_model_coherence_{k + 1}": f"full size, model only: coherence in octave {k + 1}"
        for k in range(OCTAVES)
    },
}
