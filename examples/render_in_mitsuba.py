"""Renders an exported .obj in Mitsuba 3 under an environment map, as `univoxel relight` does.

    pip install mitsuba
    python render_in_mitsuba.py sneaker.obj studio.hdr transforms_test.json out/

Each frame becomes an EXR file of linear colour with alpha. The file of cameras gives the size of
the pictures as w and h.
"""

import json
import math
import sys
from pathlib import Path

import mitsuba as mi

SAMPLES = 128

mi.set_variant("scalar_rgb")
T = mi.ScalarTransform4f
mesh, envmap, cameras, out = map(Path, sys.argv[1:])


def texture(kind, raw):
    picture = mesh.with_name(f"{mesh.stem}_{kind}.png")
    return {"type": "bitmap", "filename": str(picture), "raw": raw, "wrap_mode": "clamp"}


material = {
    "type": "principled",
    "base_color": texture("albedo", raw=False),
    "roughness": texture("roughness", raw=True),
    "specular": 0.5,  # F0 = 0.04
}
# Mitsuba's maps have +Y up and look along +Z where ours look along -X: (x, y, z) -> (y, z, x)
turn = T([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
scene = mi.load_dict(
    {
        "type": "scene",
        "light": {"type": "envmap", "filename": str(envmap), "to_world": turn},
        "object": {
            "type": "obj",
            "filename": str(mesh),
            "bsdf": {
                "type": "normalmap",
                "normalmap": texture("normal", raw=True),
                "bsdf": material,
            },
        },
    }
)
description = json.loads(cameras.read_text())
out.mkdir(parents=True, exist_ok=True)
for frame in description["frames"]:
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": math.degrees(description["camera_angle_x"]),
            "fov_axis": "x",
            # Mitsuba's cameras look along +Z and have +X to the left.
            "to_world": T(frame["transform_matrix"]) @ T().scale([-1, 1, -1]),
            "film": {
                "type": "hdrfilm",
                "width": description["w"],
                "height": description["h"],
                "pixel_format": "rgba",
                "rfilter": {"type": "box"},
            },
        }
    )
    integrator = mi.load_dict({"type": "path", "max_depth": 4, "hide_emitters": True})
    image = mi.render(scene, sensor=sensor, integrator=integrator, spp=SAMPLES)
    name = f"{Path(frame['file_path']).name}.exr"
    mi.Bitmap(image).convert(component_format=mi.Struct.Type.Float16).write(str(out / name))
