"""Textured meshes as Wavefront OBJ with a material library and pictures beside it."""

from __future__ import annotations

from pathlib import Path

from univoxel.assets.base import (
    TexturedMesh,
    albedo_picture,
    encoded,
    metallic_picture,
    relief_picture,
    roughness_picture,
)
from univoxel.errors import UserError
from univoxel.files import replacing


def write_obj(path: Path, mesh: TexturedMesh, jpeg: int | None = None) -> None:
    """Write NAME.obj, NAME.mtl and NAME_{albedo,roughness,normal}.png, each whole or not at all.

    A mesh with metal has a NAME_metallic.png besides. Positions stay in the world's axes, +Z up.
    The .obj comes last: where it is, the others are. Roughness, metallic and normal map stand in
    the widespread extension for physically based materials (Pr, Pm, map_Pr, map_Pm, norm); OBJ has
    no tangents, programs compute their own.

    Args:
        jpeg: quality of pictures as .jpg, 1 to 95; None: .png, which loses nothing.

    Raises:
        OSError: a file cannot be written.
        ValueError: white space in the name, at which readers of OBJ split.
    """
    name = path.stem
    if name.split() != [name]:
        raise UserError(f"{path}: readers of OBJ need a file name without spaces")
    pictures = {
        "albedo": albedo_picture(mesh),
        "roughness": roughness_picture(mesh),
        "normal": relief_picture(mesh),
    }
    metal, suffix = "Pm 0", "png" if jpeg is None else "jpg"
    if mesh.metallic is not None:
        pictures["metallic"] = metallic_picture(mesh)
        metal = f"Pm 1\nmap_Pm {name}_metallic.{suffix}"
    for kind, picture in pictures.items():
        with replacing(path.with_name(f"{name}_{kind}.{suffix}")) as temporary:
            temporary.write_bytes(encoded(picture, jpeg))
    material = f"""newmtl object
Kd 1 1 1
Ks 0 0 0
Pr 1
{metal}
Ni 1.5
illum 2
map_Kd {name}_albedo.{suffix}
map_Pr {name}_roughness.{suffix}
norm {name}_normal.{suffix}
"""
    _write_text(path.with_suffix(".mtl"), material)
    corners = (mesh.faces + 1).tolist()  # v/vt/vn of each corner are the same
    parts = [f"# univoxel: +Z up\nmtllib {name}.mtl\no object\n"]
    for line, values in (
        ("v %.7g %.7g %.7g\n", mesh.vertices),
        ("vt %.7g %.7g\n", mesh.uv),
        ("vn %.6f %.6f %.6f\n", mesh.normals),
    ):
        parts += [line % tuple(row) for row in values.tolist()]
    parts.append("usemtl object\ns 1\n")
    parts += [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}\n" for a, b, c in corners]
    _write_text(path, "".join(parts))


def _write_text(path: Path, text: str) -> None:
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
