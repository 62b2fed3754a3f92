"""Charts of a mesh: the place of each triangle in a texture, and what is seen at its texels."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag, grid_sample

from univoxel.color import luminance, srgb_to_linear
from univoxel.core.records import Mesh
from univoxel.ops import native
from univoxel.ops.differentiable import check

PADDING = 4  # texels between charts: two mip levels stay apart
# Faces of a region, about: no chart goes beyond it. The search takes longer than its faces grow
REGION = 2000
LINEAR = srgb_to_linear(torch.arange(256) / 255)  # of bytes
AT_ONCE = 1 << 20  # texels: bounds memory
CLIPPED, OF_CLIPPED = 0.98, 0.05  # linear; the weight of what is brighter
INSIDE = 0.95  # of a mask, above which a pixel is the object's


def unwrap(mesh: Mesh, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Cut a mesh into charts and pack them into a square of size x size texels.

    Returns:
        source [Q] int64, the vertex of `mesh` that each new one copies; faces [F, 3] int32, in the
        order of `mesh`; uv [Q, 2] float32 in [0, 1], v upwards. No chart is mirrored.

    Raises:
        ValueError: a face names a vertex that is not there.
        MissingNative: the compiled extension is missing.

    Source: Young 2018, xatlas, which is compiled into the extension: third_party/xatlas.
    """
    vertices, faces = mesh.vertices.float().contiguous(), mesh.faces.int().contiguous()
    arrays = native.arrays(vertices, faces, _regions(vertices, faces).int())
    charts = native.require().find_charts(*arrays, size, PADDING)
    new, triangles = charts.count()
    source = torch.empty(new, dtype=torch.int64)
    corners = torch.empty(triangles, 3, dtype=torch.int32)
    uv = torch.empty(new, 2)
    charts.write(*native.arrays(source, corners, uv))
    return source, corners, uv.clamp_(0, 1)


def _regions(vertices: Tensor, faces: Tensor) -> Tensor:
    """A number [F] for each face: of the cell of a coarse grid that its first corner lies in."""
    cells = math.ceil((len(faces) / REGION) ** (1 / 3))
    corner = vertices[faces[:, 0].long().clamp(0, len(vertices) - 1)]
    low, high = corner.amin(0), corner.amax(0)
    cell = (cells * (corner - low) / (high - low).clamp_min(1e-12)).int().clamp(0, cells - 1)
    return (cell * torch.tensor([1, cells, cells * cells])).sum(1)


def rasterise(uv: Tensor, faces: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """The texels whose centres lie in a triangle.

    Texel (row r, column c) has its centre at u = (c + 0.5) / size, v = 1 - (r + 0.5) / size.

    Returns:
        texel [K] int64 = r * size + c, each once and ascending; face [K] int32, the last of those
        that hold it; barycentric [K, 2] float32, as in `ops.Hit`.

    Raises:
        ValueError: a face names a corner that is not there.
        MissingNative: the compiled extension is missing.
    """
    found, rows = [], max(1, AT_ONCE // size)
    for top in range(0, size, rows):
        owner = torch.empty(min(rows, size - top), size, dtype=torch.int32)
        barycentric = torch.empty(*owner.shape, 2)
        arrays = native.arrays(uv.contiguous(), faces.int().contiguous(), owner, barycentric)
        native.require().rasterise(*arrays, top)
        held = (owner.view(-1) >= 0).nonzero()[:, 0]
        found.append((held + top * size, owner.view(-1)[held], barycentric.view(-1, 2)[held]))
    texel, face, barycentric = (torch.cat(part) for part in zip(*found, strict=True))
    return texel, face, barycentric


def corner_weights(barycentric: Tensor) -> Tensor:
    """(u, v) [N, 2] of `ops.Hit` as weights of the three corners [N, 3]."""
    return torch.cat([1 - barycentric.sum(1, keepdim=True), barycentric], 1)


def between(values: Tensor, corner: Tensor, weights: Tensor) -> Tensor:
    """Values [P, C] of vertices at points of faces, [N, C].

    Args:
        corner: [N, 3] int32 rows of `values`.
        weights: [N, 3] of the corners.
    """
    return embedding_bag(corner, values, per_sample_weights=weights, mode="sum")


def linear(picture: Tensor) -> Tensor:
    """A stored picture [..., 3], uint8 sRGB or float32 linear, as the latter."""
    return LINEAR[picture.int()] if picture.dtype == torch.uint8 else picture


def sampled(picture: Tensor, place: Tensor) -> Tensor:
    """Linear colours [N, 3] of a picture at places, bilinear in linear light.

    Args:
        picture: [H, W, 3] uint8 sRGB, or float32 linear.
        place: [N, 2] x to the right and y down, in pixels; a pixel's centre is at a half.
    """
    if not native.serves(place):
        return sampled_reference(picture, place)
    colors = torch.empty(len(place), 3)
    native.call("sample_picture", *(t.contiguous() for t in (picture, LINEAR, place)), colors)
    return colors


def sampled_reference(picture: Tensor, place: Tensor) -> Tensor:
    """Reference in eager PyTorch."""
    size = torch.tensor([picture.shape[1], picture.shape[0]])
    at = (2 * place / size - 1)[None, None]
    planes = linear(picture).movedim(-1, 0)[None]
    found = grid_sample(planes, at, padding_mode="border", align_corners=False)
    return found[0, :, 0].T


def add_photograph_(
    total: Tensor,  # [K, 3]
    weights: Tensor,  # [K]
    face: Tensor,  # [K] int32
    barycentric: Tensor,  # [K, 2] float16
    corners: Tensor,  # [F, 3] int32
    shown: Tensor,  # [F] bool
    values: Tensor,  # [P, 13]
    matrix: Tensor,  # [3, 4]
    mask: Tensor,  # [h, w]
    picture: Tensor,  # [H, W, 3]
    scale: float,
) -> None:
    """Add the albedo that a photograph shows at the texels of a mesh, in place.

    The model splits the linear colour c of a point into albedo * A + B. A texel gets
    (c - B) / A in [0, 1], times its trust: the interpolated weight, times the luminance of A, times
    the squared share of albedo * A in the luminance of the whole, times OF_CLIPPED where c is
    clipped. Where B hides some channels more than others, the colour of (c - B) / A means nothing:
    the result moves towards the model's albedo, scaled to the same luminance.

    Args:
        total, weights: sums so far of trust times albedo, and of trust.
        face, barycentric: of each texel, as in `ops.Hit`.
        corners: [F, 3] rows of `values`.
        shown: [F] whether the photograph shows a face.
        values: [P, 13] float32 at the vertices: A, B, world position, the model's albedo (three
            numbers each), and the weight of the photograph.
        matrix: [3, 4] world to (x z, y z, z), with x and y in pixels of the mask.
        mask: [h, w] float32 in [0, 1]; a texel counts where it is above INSIDE.
        picture: [H, W, 3] uint8 sRGB, or float32 linear.
        scale: pixels of the picture in one of the mask.

    Raises:
        TypeError, ValueError: an argument has another size or dtype than above.
    """
    check(
        "add_photograph_",
        total=(total, "K 3", torch.float32),
        weights=(weights, "K", torch.float32),
        face=(face, "K", torch.int32),
        barycentric=(barycentric, "K 2", torch.float16),
        corners=(corners, "F 3", torch.int32),
        shown=(shown, "F", torch.bool),
        values=(values, "P 13", torch.float32),
        matrix=(matrix, "3 4", torch.float32),
        mask=(mask, "h w", torch.float32),
        picture=(picture, "H W 3", torch.uint8 if picture.dtype == torch.uint8 else torch.float32),
    )
    if not native.serves(total):
        texels = face, barycentric, corners, shown, values, matrix, mask, picture, scale
        add_photograph_reference_(total, weights, *texels)
        return
    texels = face, barycentric, corners, shown.view(torch.uint8), values, matrix, mask, LINEAR
    tensors = [t.contiguous() for t in (*texels, picture)]
    native.call("add_photograph", *tensors, total, weights, scale, CLIPPED, OF_CLIPPED)


def add_photograph_reference_(total: Tensor, weights: Tensor, *texels: Any) -> None:
    """Reference in eager PyTorch."""
    some, color, at = seen_at_texels(*texels)
    a, b, albedo, weight = at[:, :3], at[:, 3:6], at[:, 9:12], at[:, 12]
    trusted = weight * luminance(a) * (color.amax(1) < CLIPPED).float().clamp_min(OF_CLIPPED)
    model = a * albedo
    trusted *= (luminance(model) / luminance(model + b).clamp_min(1e-6)).square()
    own = model / (model + b).clamp_min(1e-6)  # share that is no reflection
    even = (own.amin(1) / own.amax(1).clamp_min(1e-6)).square()[:, None]
    value = ((color - b) / a.clamp_min(1e-3)).clamp(0, 1)
    bright = luminance(value) / luminance(albedo).clamp_min(1e-4)
    value = torch.lerp((albedo * bright[:, None]).clamp(0, 1), value, even)
    total.index_add_(0, some, trusted[:, None] * value)
    weights.index_add_(0, some, trusted)


def seen_at_texels(
    face: Tensor,
    barycentric: Tensor,
    corners: Tensor,
    shown: Tensor,
    values: Tensor,
    matrix: Tensor,
    mask: Tensor,
    picture: Tensor,
    scale: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """What `add_photograph_` looks up: the texels that count [N], colours [N, 3], values [N, 13].

    Args: as in `add_photograph_`.
    """
    some = shown[face].nonzero()[:, 0]
    at = between(values, corners[face[some]], corner_weights(barycentric[some].float()))
    x, y, z = (at[:, 6:9] @ matrix[:, :3].T + matrix[:, 3]).unbind(1)
    pixel = torch.stack([x, y], 1) / z[:, None]
    size = torch.tensor([mask.shape[1], mask.shape[0]])
    cover = grid_sample(mask[None, None], (2 * pixel / size - 1)[None, None], align_corners=False)
    inside = ((pixel > 0.5) & (pixel < size - 0.5)).all(1) & (cover[0, 0, 0] > INSIDE)
    kept = (inside & (at[:, 12] > 0)).nonzero()[:, 0]
    return some[kept], sampled(picture, scale * pixel[kept]), at[kept]
