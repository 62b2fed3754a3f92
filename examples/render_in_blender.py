"""Renders an exported .glb in Blender under an environment map, as `univoxel relight` does.

    pip install bpy    # each version is made for one Python: pip says which there are
    python render_in_blender.py sneaker.glb studio.hdr transforms_test.json out/

Blender turns glTF back to +Z up, and its world textures have the axes of
docs/reference/conventions.md: map and cameras need no turning. Each frame becomes an EXR file of
linear colour with alpha. The file of cameras gives the size of the pictures as w and h.
"""

import json
import sys
from pathlib import Path

import bpy
from mathutils import Matrix

SAMPLES = 128

mesh, envmap, cameras, out = map(Path, sys.argv[1:])
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=str(mesh.resolve()))
scene = bpy.context.scene

world = bpy.data.worlds.new("world")
world.use_nodes = True
texture = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
texture.image = bpy.data.images.load(str(envmap.resolve()))
background = world.node_tree.nodes["Background"]
world.node_tree.links.new(texture.outputs["Color"], background.inputs["Color"])
scene.world = world

description = json.loads(cameras.read_text())
camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
camera.data.angle_x = description["camera_angle_x"]
scene.collection.objects.link(camera)
scene.camera = camera

scene.render.engine = "CYCLES"
scene.cycles.samples = SAMPLES
scene.cycles.use_denoising = False
scene.cycles.pixel_filter_type = "BOX"
scene.cycles.max_bounces = 2
scene.render.resolution_x, scene.render.resolution_y = description["w"], description["h"]
scene.render.film_transparent = True
scene.render.image_settings.file_format = "OPEN_EXR"
for frame in description["frames"]:
    camera.matrix_world = Matrix(frame["transform_matrix"])
    scene.render.filepath = str((out / Path(frame["file_path"]).name).resolve())
    bpy.ops.render.render(write_still=True)
