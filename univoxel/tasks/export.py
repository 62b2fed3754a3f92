"""The surface of a trained scene as a mesh file."""

from __future__ import annotations

from pathlib import Path

from univoxel.assets.bake import bake, with_materials
from univoxel.assets.gltf import write_glb
from univoxel.assets.obj import write_obj
from univoxel.assets.ply import write_ply
from univoxel.assets.topology import clean, close, simplify
from univoxel.checkpoint import load_scene
from univoxel.errors import UserError
from univoxel.names import TEXTURE_SIZE
from univoxel.records import Mesh

SUFFIXES = (".glb", ".obj", ".ply")
TEXTURED_FACES = 20_000  # of textured meshes: the texture holds what they are too coarse for
TEXTURE_SIZES = (16, 4096)


def export(
    run: str | Path,
    mesh: str | Path,
    *,
    faces: int | None = None,
    texture_size: int = TEXTURE_SIZE,
    watertight: bool = False,
) -> None:
    """Write the zero level of a scene's sdf with its materials; see docs/guide/export.md.

    Args:
        run: folder of the trained scene.
        mesh: the file to write, whole or not at all: .glb and .obj hold textures, .ply holds
            materials at the vertices.
        faces: most triangles, at least 4; when left out 20000 with textures, all without.
        texture_size: texels along a side of each texture, a power of 2 from 16 to 4096.
        watertight: close holes.

    Raises:
        UserError: the run cannot be used, an argument is out of range, there is
            no surface, or none that can be closed.
        OSError: a file cannot be written.
    """
    mesh = Path(mesh)
    suffix = mesh.suffix.lower()
    if suffix not in SUFFIXES:
        raise UserError(
            f"export: mesh: expected a file that ends in {', '.join(SUFFIXES)}, got {mesh}", "mesh"
        )
    if faces is not None and faces < 4:
        raise UserError(f"export: faces must be at least 4, got {faces}", "faces")
    low, high = TEXTURE_SIZES
    if not low <= texture_size <= high or texture_size & (texture_size - 1):
        raise UserError(
            f"export: texture_size must be a power of 2 from {low} to {high}, got {texture_size}",
            "texture_size",
        )
    scene = load_scene(Path(run))
    surface = clean(Mesh(*scene.field.isosurface()))
    if watertight:
        surface = close(surface)
    most = TEXTURED_FACES if faces is None and suffix != ".ply" else faces
    if most is not None:
        surface = simplify(surface, most)
    if watertight:
        surface = close(surface)  # what decimation has torn
    mesh.parent.mkdir(parents=True, exist_ok=True)
    match suffix:
        case ".glb":
            write_glb(mesh, bake(scene, surface, texture_size))
        case ".obj":
            write_obj(mesh, bake(scene, surface, texture_size))
        case ".ply":
            write_ply(mesh, with_materials(scene, surface))
