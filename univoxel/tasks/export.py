"""The surface of a trained scene as a mesh file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from univoxel.assets.bake import bake, with_materials
from univoxel.assets.gltf import write_glb
from univoxel.assets.obj import write_obj
from univoxel.assets.placement import Placement, placed, placement_of
from univoxel.assets.ply import write_ply
from univoxel.assets.topology import clean, close, simplify
from univoxel.assets.usd import require_usd, write_usdz
from univoxel.checkpoint import load_scene
from univoxel.errors import UserError
from univoxel.names import (
    ORIGINS,
    TEXTURE_FORMATS,
    TEXTURE_QUALITY,
    TEXTURE_SIZE,
    Origin,
    TextureFormat,
)
from univoxel.records import Mesh
from univoxel.scene import Scene

SUFFIXES = (".glb", ".obj", ".ply", ".usdz")
TEXTURED_FACES = 20_000  # of textured meshes: the texture holds what they are too coarse for
TEXTURE_SIZES = (16, 4096)
QUALITIES = (1, 95)  # of JPEG textures; above, files grow and lose as much
LODS = (0, 8)
FEWER = 4  # times fewer triangles from level to level: their edges become twice as long
LEAST_FACES = 32  # of the coarsest level: with fewer no shape is left


@dataclass(frozen=True)
class ExportOptions:
    """How a surface becomes a file.

    Raises:
        UserError: an argument is out of range.
    """

    faces: int | None = None  # most triangles, at least 4; None: 20000 with textures, all without
    texture_size: int = TEXTURE_SIZE  # texels along a side of each, a power of 2 from 16 to 4096
    watertight: bool = False  # close holes
    texture_format: TextureFormat = "png"
    quality: int = TEXTURE_QUALITY  # of JPEG textures, 1 to 95
    size: float | None = None  # the longest side of the bounding box; None: as it is
    origin: Origin = "world"  # what lies at 0; bottom: the middle of the box's floor
    lods: int = 0  # coarser levels, 0 to 8, each with a quarter of the triangles

    def __post_init__(self) -> None:
        if self.faces is not None and self.faces < 4:
            raise UserError(f"export: faces must be at least 4, got {self.faces}", "faces")
        low, high = TEXTURE_SIZES
        size = self.texture_size
        if not low <= size <= high or size & (size - 1):
            raise UserError(
                f"export: texture_size must be a power of 2 from {low} to {high}, got {size}",
                "texture_size",
            )
        for name, known in (("texture_format", TEXTURE_FORMATS), ("origin", ORIGINS)):
            if (value := getattr(self, name)) not in known:
                raise UserError(f"export: {name} must be {' or '.join(known)}, got {value}", name)
        for name, (low, high) in (("quality", QUALITIES), ("lods", LODS)):
            if not low <= (value := getattr(self, name)) <= high:
                raise UserError(f"export: {name} must be {low} to {high}, got {value}", name)
        if self.size is not None and not 0 < self.size < math.inf:
            raise UserError(f"export: size must be above 0, got {self.size:g}", "size")
        if self.faces is not None and self.lods:
            require_levels(self.faces, self.lods)

    @property
    def jpeg(self) -> int | None:
        """Quality of JPEG textures; None: PNG."""
        return self.quality if self.texture_format == "jpeg" else None


def require_levels(faces: int, lods: int) -> None:
    """Refuse levels of detail that would have next to no triangles.

    Raises:
        UserError: the coarsest would.
    """
    coarsest = faces // FEWER**lods
    if coarsest < LEAST_FACES:
        raise UserError(
            f"export: lods={lods} of {faces} faces leave {coarsest} in the coarsest level, expected"
            f" at least {LEAST_FACES}",
            "lods",
        )


def level_path(mesh: Path, level: int) -> Path:
    """The file of a level of detail: NAME.glb is the finest, NAME_lod1.glb the next."""
    return mesh.with_name(f"{mesh.stem}_lod{level}{mesh.suffix}") if level else mesh


def export(run: str | Path, mesh: str | Path, **options: Any) -> list[Path]:
    """Write the zero level of a scene's sdf with its materials; see docs/guide/export.md.

    Args:
        run: folder of the trained scene.
        mesh: the file to write, whole or not at all: .glb, .usdz and .obj hold textures, .ply holds
            materials at the vertices.
        options: fields of `ExportOptions`.

    Returns:
        The files of the levels of detail, the finest first: `mesh` alone without others.

    Raises:
        UserError: the run cannot be used, an argument is out of range, there is
            no surface, or none that can be closed.
        MissingExtra: .usdz without usd-core.
        OSError: a file cannot be written.
    """
    mesh, chosen = Path(mesh), ExportOptions(**options)
    suffix = mesh.suffix.lower()
    if suffix not in SUFFIXES:
        raise UserError(
            f"export: mesh: expected a file that ends in {', '.join(SUFFIXES)}, got {mesh}", "mesh"
        )
    if suffix == ".usdz":
        require_usd()
    scene = load_scene(Path(run))
    surface = clean(Mesh(*scene.field.isosurface()))
    if chosen.watertight:
        surface = close(surface)
    most = TEXTURED_FACES if chosen.faces is None and suffix != ".ply" else chosen.faces
    most = len(surface.faces) if most is None else min(most, len(surface.faces))
    if chosen.lods:
        require_levels(most, chosen.lods)
    mesh.parent.mkdir(parents=True, exist_ok=True)
    placement, written = None, []
    for level in range(chosen.lods + 1):
        reduced = simplify(surface, most // FEWER**level)
        if chosen.watertight:
            reduced = close(reduced)  # what decimation has torn
        if placement is None:  # all levels where the finest lies
            placement = placement_of(reduced.vertices, chosen.size, chosen.origin)
        written.append(level_path(mesh, level))
        size = max(chosen.texture_size >> level, TEXTURE_SIZES[0])
        _write(written[-1], scene, reduced, placement, size, chosen.jpeg)
    return written


def _write(
    path: Path, scene: Scene, surface: Mesh, placement: Placement, size: int, jpeg: int | None
) -> None:
    """Write a surface, given in the scene's world, as its file's name says."""
    match path.suffix.lower():
        case ".glb":
            write_glb(path, placed(bake(scene, surface, size), placement), jpeg)
        case ".usdz":
            write_usdz(path, placed(bake(scene, surface, size), placement), jpeg)
        case ".obj":
            write_obj(path, placed(bake(scene, surface, size), placement), jpeg)
        case ".ply":
            write_ply(path, placed(with_materials(scene, surface), placement))
