"""The surface of a trained scene as a mesh file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from univoxel.cli.parsing import ADVANCED, File, Run, takes, written
from univoxel.core import choices
from univoxel.core.files import write_bytes
from univoxel.errors import UserError, demand

SUFFIXES = (".glb", ".obj", ".ply", ".usdz")
TEXTURED_FACES = 20_000  # of textured meshes: the texture holds what they are too coarse for
TEXTURE_SIZES = (16, 4096)
QUALITIES = (1, 95)  # of JPEG textures; above, files grow and lose as much
LODS = (0, 8)
FEWER = 4  # times fewer triangles from level to level: their edges become twice as long
LEAST_FACES = 32  # of the coarsest level: with fewer no shape is left


@dataclass(frozen=True)
class ExportOptions:
    """How a surface becomes a file; a UserError for an option out of range."""

    run: Run
    """folder of a trained run"""
    mesh: Annotated[File, written("FILE.glb|usdz|obj|ply")]
    """mesh file to write; .glb, .usdz and .obj have textures, .ply has vertex colours"""
    faces: Annotated[int | None, written("N", "20000 with textures, else no limit")] = None
    """maximum number of triangles, at least 4"""
    texture_size: Annotated[
        int | None, written("TEXELS", "that of the full-size texture, else 1024")
    ] = None
    """width of the square textures, a power of 2 up to 4096"""
    watertight: bool = False
    """close all holes, or fail if that is impossible"""
    texture_format: Annotated[choices.TextureFormat, ADVANCED] = "png"
    """png is lossless, jpeg is smaller"""
    quality: Annotated[int, written("1-95", advanced=True)] = choices.TEXTURE_QUALITY
    """JPEG quality"""
    size: Annotated[float | None, written("METRES", "as photographed")] = None
    """length of the object's longest side"""
    origin: Annotated[choices.Origin, ADVANCED] = "upright"
    """position of the origin; world: as in the data set; upright: the same, with +Z up"""
    lods: Annotated[int, written("N", advanced=True)] = 0
    """also write N coarser meshes, each with 1/4 of the triangles of the one before"""

    def __post_init__(self) -> None:
        demand(self.faces is None or self.faces >= 4, "faces", "at least 4", self.faces)
        (low, high), texels = TEXTURE_SIZES, self.texture_size
        fits = texels is None or (low <= texels <= high and not texels & (texels - 1))
        demand(fits, "texture_size", f"a power of 2 from {low} to {high}", texels)
        words = {"texture_format": choices.TEXTURE_FORMATS, "origin": choices.ORIGINS}
        for name, known in words.items():
            value = getattr(self, name)
            demand(value in known, name, " or ".join(known), value)
        for name, (low, high) in {"quality": QUALITIES, "lods": LODS}.items():
            value = getattr(self, name)
            demand(low <= value <= high, name, f"from {low} to {high}", value)
        demand(self.size is None or 0 < self.size < math.inf, "size", "above 0", self.size)
        if self.faces is not None and self.lods:
            require_levels(self.faces, self.lods)

    @property
    def jpeg(self) -> int | None:
        """Quality of JPEG textures; None: PNG."""
        return self.quality if self.texture_format == "jpeg" else None


def require_levels(faces: int, lods: int) -> None:
    """Refuse, by a UserError, levels of detail of which the coarsest has next to no triangles."""
    coarsest = faces // FEWER**lods
    if coarsest < LEAST_FACES:
        raise UserError(
            f"export: lods={lods} with {faces} faces leaves {coarsest} faces in the coarsest "
            f"level, expected at least {LEAST_FACES}",
            "lods",
        )


@takes(ExportOptions)
def export(asked: ExportOptions) -> list[Path]:
    """Export the surface as a mesh with materials.

    Returns:
        The files of the levels of detail, finest first; each is written atomically.

    Raises:
        UserError: the run cannot be used, an argument is out of range, there is
            no surface, or it cannot be closed.
        MissingExtra: .usdz without usd-core.
        OSError: a file cannot be written.
    """
    from univoxel.detail.texture import load_detail
    from univoxel.output.mesh import bake, placed, placement_of, with_materials
    from univoxel.output.mesh_files import glb, require_usd, write_obj, write_ply, write_usdz
    from univoxel.output.surface import cameras_of, surface_of
    from univoxel.output.topology import close, simplify
    from univoxel.run import load_world
    from univoxel.scene import load_scene

    mesh = Path(asked.mesh)
    suffix = mesh.suffix.lower()
    if suffix not in SUFFIXES:
        raise UserError(
            f"export: mesh: expected a file that ends in {', '.join(SUFFIXES)}, got {mesh}", "mesh"
        )
    if suffix == ".usdz":
        require_usd()
    run = Path(asked.run)
    scene, detail = load_scene(run), load_detail(run)
    widest = asked.texture_size
    if widest is None:
        widest = choices.TEXTURE_SIZE
        if detail is not None:
            widest = min(len(detail.albedo), TEXTURE_SIZES[1])
    surface = surface_of(scene, cameras_of(scene, run))
    if asked.watertight:
        surface = close(surface)
    most = TEXTURED_FACES if asked.faces is None and suffix != ".ply" else asked.faces
    most = len(surface.faces) if most is None else min(most, len(surface.faces))
    if asked.lods:
        require_levels(most, asked.lods)
    mesh.parent.mkdir(parents=True, exist_ok=True)
    placement, written = None, []
    for level in range(asked.lods + 1):
        reduced = simplify(surface, most // FEWER**level)
        if asked.watertight:
            reduced = close(reduced)  # what decimation has torn
        if placement is None:  # all levels where the finest lies
            moved = load_world(run) if asked.origin == "world" else None
            placement = placement_of(reduced.vertices, asked.size, asked.origin, moved)
        path = mesh.with_name(f"{mesh.stem}_lod{level}{mesh.suffix}") if level else mesh
        if suffix == ".ply":
            write_ply(path, placed(with_materials(scene, reduced), placement))
        else:
            size = max(widest >> level, TEXTURE_SIZES[0])
            near = None if detail is None else detail.near
            textured = placed(bake(scene, reduced, size, near), placement)
            if suffix == ".glb":
                write_bytes(path, glb(textured, asked.jpeg))
            else:
                {".usdz": write_usdz, ".obj": write_obj}[suffix](path, textured, asked.jpeg)
        written.append(path)
    return written


command = export
