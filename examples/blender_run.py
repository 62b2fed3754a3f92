"""Opens a run in Blender: the mesh, its light, and the cameras with their photographs.

    python blender_run.py prepare runs/mug mug_blender    # where univoxel is installed
    blender --python blender_run.py -- mug_blender        # to look at it

The first command writes a folder of files that any program reads; the second needs no univoxel.
Where Blender is installed as a Python package (pip install bpy), the second goes without a window:

    python blender_run.py mug_blender --save mug.blend --render r_3 r_3.exr

Each photograph has a frame of the timeline: to step through frames is to step through cameras.
"""

import argparse
import json
import sys
from pathlib import Path

SENSOR = 36.0  # mm, Blender's
OVERLAY = 0.5  # opacity of a photograph over what its camera sees
FACES = 100_000  # most triangles
SAMPLES = 128  # of Cycles


def lens_of(focal, centre, size):
    """A pinhole camera in Blender's words.

    Args:
        focal, centre: (x, y) in pixels, the centre from the top left corner.
        size: (width, height) in pixels.

    Returns:
        Millimetres on a sensor that is fitted horizontally; shifts of the picture in its widths;
        how much wider and higher a pixel is than a square one.
    """
    (fx, fy), (cx, cy), (width, height) = focal, centre, size
    return {
        "lens": SENSOR * fx / width,
        "shift_x": 0.5 - cx / width,
        "shift_y": (cy - height / 2) * (fx / fy) / width,
        "aspect_x": max(1.0, fy / fx),
        "aspect_y": max(1.0, fx / fy),
    }


def prepare(run, folder):
    """Write object.glb, light.exr, photographs/ and cameras.json of a run."""
    import numpy as np
    from PIL import Image

    import univoxel
    from univoxel.cli.envmap import envmap
    from univoxel.color import linear_to_srgb
    from univoxel.run import photos_of

    found = univoxel.open_run(run)
    (folder / "photographs").mkdir(parents=True, exist_ok=True)
    found.export(folder / "object.glb", faces=FACES, texture_size=2048)
    envmap(run, folder / "light.exr")
    photos = found.scene.registered(photos_of(Path(run), split="train"))
    views = []
    for view, name in enumerate(photos.names):
        color, alpha = photos.picture(view)
        rgba = np.concatenate([linear_to_srgb(color).numpy(), alpha.numpy()[..., None]], 2)
        picture = f"photographs/{view:04d}.png"
        Image.fromarray((255 * rgba.clip(0, 1) + 0.5).astype(np.uint8)).save(folder / picture)
        cameras = photos.cameras
        size = cameras.size(view)
        views.append(
            {
                "name": name,
                "picture": picture,
                "size": size,
                "camera_to_world": cameras.camera_to_world[view].tolist(),
                **lens_of(cameras.focal[view].tolist(), cameras.centre[view].tolist(), size),
            }
        )
    (folder / "cameras.json").write_text(json.dumps({"views": views}, indent=1), encoding="utf-8")


def load(folder):
    """Fill an empty scene with what `prepare` wrote; the cameras, by the names of photographs."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    # The importer turns glTF back to +Z up: then it lies where cameras and light expect it.
    bpy.ops.import_scene.gltf(filepath=str(folder / "object.glb"))
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples = SAMPLES
    scene.render.film_transparent = True
    scene.view_settings.view_transform = "Standard"  # sRGB, as photographs are
    scene.world = _lit_by(folder / "light.exr")
    views = json.loads((folder / "cameras.json").read_text(encoding="utf-8"))["views"]
    group = bpy.data.collections.new("photographs")
    scene.collection.children.link(group)
    cameras = {}
    for frame, view in enumerate(views, 1):
        camera = cameras[view["name"]] = _camera(folder, view)
        group.objects.link(camera)
        scene.timeline_markers.new(view["name"], frame=frame).camera = camera
    scene.frame_start, scene.frame_end = 1, len(views)
    look_through(scene, next(iter(cameras.values())))
    return scene, cameras


def look_through(scene, camera):
    """Make a camera the scene's, and pictures as large as its photograph."""
    scene.camera = camera
    scene.render.resolution_x, scene.render.resolution_y = camera["size"]
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = camera["aspect"]


def _lit_by(path):
    """A world of an environment map, whose axes are Blender's."""
    import bpy

    world = bpy.data.worlds.new("light")
    if bpy.app.version < (5, 0):  # later ones have nodes from the beginning
        world.use_nodes = True
    texture = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
    texture.image = bpy.data.images.load(str(path))
    background = world.node_tree.nodes["Background"]
    world.node_tree.links.new(texture.outputs["Color"], background.inputs["Color"])
    return world


def _camera(folder, view):
    """A camera with its photograph, which is seen through it; its axes are Blender's."""
    import bpy
    from mathutils import Matrix

    data = bpy.data.cameras.new(view["name"])
    data.sensor_fit, data.sensor_width = "HORIZONTAL", SENSOR
    data.lens, data.shift_x, data.shift_y = view["lens"], view["shift_x"], view["shift_y"]
    data.show_background_images = True
    photograph = data.background_images.new()
    photograph.image = bpy.data.images.load(str(folder / view["picture"]))
    photograph.alpha, photograph.display_depth = OVERLAY, "FRONT"
    camera = bpy.data.objects.new(view["name"], data)
    camera.matrix_world = Matrix([*view["camera_to_world"], [0, 0, 0, 1]])
    camera["size"], camera["aspect"] = view["size"], [view["aspect_x"], view["aspect_y"]]
    return camera


def render(scene, camera, path, samples):
    """Render what a camera sees with Cycles into an EXR file, linear and premultiplied."""
    import bpy

    look_through(scene, camera)
    scene.timeline_markers.clear()  # they would choose the camera of the frame
    scene.cycles.samples, scene.cycles.use_denoising = samples, False
    scene.cycles.pixel_filter_type, scene.cycles.max_bounces = "BOX", 2
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


def main(arguments):
    if arguments[:1] == ["prepare"]:
        parser = argparse.ArgumentParser(prog="blender_run.py prepare")
        parser.add_argument("run", type=Path, help="folder of a trained run")
        parser.add_argument("folder", type=Path, help="folder to write")
        options = parser.parse_args(arguments[1:])
        prepare(options.run, options.folder)
        return
    parser = argparse.ArgumentParser(prog="blender_run.py")
    parser.add_argument("folder", type=Path, help="what prepare wrote")
    parser.add_argument("--save", type=Path, metavar="FILE.blend")
    parser.add_argument("--render", nargs=2, metavar=("VIEW", "FILE.exr"))
    parser.add_argument("--samples", type=int, default=SAMPLES)
    options = parser.parse_args(arguments)
    scene, cameras = load(options.folder.resolve())
    if options.save:
        import bpy

        bpy.ops.wm.save_as_mainfile(filepath=str(options.save.resolve()))
    if options.render:
        view, path = options.render
        render(scene, cameras[view], Path(path).resolve(), options.samples)


if __name__ == "__main__":
    # Blender's own arguments end with --
    main(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:])
