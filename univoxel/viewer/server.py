"""The viewer's server, built on viser. Each client has its own view and light.

viser draws the controls and moves the camera; the picture stands behind its empty scene.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from univoxel import envmap as env
from univoxel.camera import Cameras, image_rays, looked_at, pixel_rays, project, resize
from univoxel.color import linear_to_srgb
from univoxel.core import log
from univoxel.data import Photos
from univoxel.errors import UserError
from univoxel.ops import Sun
from univoxel.output.mesh import bake, encoded
from univoxel.output.mesh_files import glb
from univoxel.output.page import FACES, JPEG_QUALITY, Light, PageOptions, light_of_file, lights_of
from univoxel.output.topology import simplify
from univoxel.output.viewpoints import VIEW_ANGLE, orbit
from univoxel.render.relight import Lighting, rotated
from univoxel.sphere import direction_at
from univoxel.viewer import frames
from univoxel.viewer.frames import LAYERS, Look
from univoxel.viewer.render_queue import Studio, Viewer, film, kind
from univoxel.viewer.training import HOST, PORT, address_of, hosted
from univoxel.viewer.viewer_scene import (
    ROWS,
    Point,
    Subject,
    incident_light,
    incident_picture,
    point_on_mesh,
)

DARK = "no map"  # the light that leaves the sun only
PLAIN = 0.16  # sRGB, behind a transparent picture
JPEG = 90  # quality of pictures that are sent
MAPS = (".hdr", ".exr")
BOX_COLOR = (255, 160, 60)


@contextlib.contextmanager
def serving(
    subject: Subject, options: PageOptions | None = None, host: str = HOST, port: int = PORT
) -> Iterator[str]:
    """A block in which a viewer answers; gives its address. Errors as of `hosted`, and a UserError
    where a map cannot be used."""
    options = options or PageOptions()
    title = options.title or (subject.run.resolve().name if subject.run else "univoxel")
    options = replace(options, title=title)
    with hosted(host, port, title) as server:
        lights = lights_of(subject.scene, options)
        start = orbit(subject.traced.mesh, 8, 512).camera_to_world[1, :, 3]
        server.initial_camera.position = start.numpy()
        server.initial_camera.look_at = torch.stack(subject.bounds).mean(0).numpy()
        server.initial_camera.fov = math.radians(VIEW_ANGLE)
        studio = Studio(subject)
        clients: dict[int, Viewer] = {}

        @server.on_client_connect
        def _(client: Any) -> None:
            clients[client.client_id] = Panel(client, subject, studio, lights, options).viewer

        @server.on_client_disconnect
        def _(client: Any) -> None:
            if viewer := clients.pop(client.client_id, None):
                studio.leave(viewer)

        try:
            yield address_of(server, host)
        finally:
            studio.stop()


class Panel:
    """A client's controls, and what they ask the studio for."""

    def __init__(
        self, client: Any, subject: Subject, studio: Studio, lights: list[Light], page: PageOptions
    ) -> None:
        self._client, self._subject, self._studio = client, subject, studio
        self._lights, self._page = {light.name: light for light in lights}, page
        self._title = page.title
        self._tables: dict[str, env.EnvTables] = {}
        self._lock = threading.Lock()
        self._last: Tensor | None = None
        self._point: Point | None = None
        self.viewer: Viewer = Viewer(self._show, self._complain)
        self._controls(client.gui)
        self._photographs(client.gui)
        self._box(client.gui)
        studio.join(self.viewer)
        client.scene.on_click()(lambda event: self._pick(event.screen_pos))
        client.camera.on_update(lambda camera: self._ask())
        self._ask()

    def _controls(self, gui: Any) -> None:
        names = [*self._lights, DARK]
        self._layer = gui.add_dropdown("layer", LAYERS, initial_value=LAYERS[0])
        self._light = gui.add_dropdown("light", names, initial_value=names[0])
        self._map = gui.add_upload_button("map from a file", hint="an .hdr or .exr file")
        self._turn = gui.add_slider("turn", -180.0, 180.0, 1.0, 0.0)
        self._exposure = gui.add_slider("exposure", -5.0, 5.0, 0.1, 0.0)
        self._sun = gui.add_slider("sun", 0.0, 10.0, 0.1, 0.0)
        self._azimuth = gui.add_slider("sun azimuth", -180.0, 180.0, 1.0, 45.0)
        self._elevation = gui.add_slider("sun elevation", 0.0, 90.0, 1.0, 45.0)
        self._ground = gui.add_checkbox("ground", False)
        self._backdrop = gui.add_checkbox("backdrop", False)
        self._denoise = gui.add_checkbox("denoise", frames.available(), visible=frames.available())
        for control in (self._layer, self._ground, self._backdrop, self._denoise):
            control.on_update(lambda event: self._ask())
        sun = self._sun, self._azimuth, self._elevation
        for control in (self._light, self._turn, self._exposure, *sun):
            control.on_update(lambda event: self._relight())
        self._map.on_upload(lambda event: self._guarded(self._take_map))
        gui.add_button("PNG").on_click(lambda event: self._guarded(self._send_png))
        gui.add_button("GLB").on_click(lambda event: self._guarded(self._send_glb))
        self._film = gui.add_button("turntable", hint="an orbit around the object as MP4 or GIF")
        self._film.on_click(lambda event: self._make_film())
        self._progress = gui.add_progress_bar(0.0, visible=False)
        nothing = np.zeros((3 * ROWS, 6 * ROWS, 3), np.uint8)
        self._arriving = gui.add_image(nothing, label="light at the point", visible=False)

    def _photographs(self, gui: Any) -> None:
        """Their frusta, and a slider that lays one over the render; nothing where they lack."""
        self._shown: int | None = None
        self._overlay = None
        try:
            photos = self._subject.photos
        except (UserError, OSError) as error:
            log.info("the photographs cannot be shown: %s", error)
            return
        self._overlay = gui.add_slider("photograph", 0.0, 1.0, 0.05, 0.0)
        self._overlay.on_update(lambda event: self._last is not None and self._show(self._last))
        choice = gui.add_dropdown("go to", ["", *photos.names], initial_value="")
        choice.on_update(
            lambda event: choice.value and self._go_to(photos.names.index(choice.value))
        )
        frusta = gui.add_checkbox("frusta", False)
        handles = []
        extent = float((self._subject.traced.mesh.vertices.abs()).max())
        for view, name in enumerate(photos.names):
            wxyz, position, angle, aspect = pose_for_viser(photos.cameras, view)
            handle = self._client.scene.add_camera_frustum(
                f"/photographs/{name}",
                fov=angle,
                aspect=aspect,
                scale=0.1 * extent,
                wxyz=wxyz,
                position=position,
                visible=False,
            )
            handle.on_click(lambda event, view=view: self._go_to(view))
            handles.append(handle)

        @frusta.on_update
        def _(event: Any) -> None:
            for handle in handles:
                handle.visible = frusta.value

    def _box(self, gui: Any) -> None:
        """Handles at two corners of a box, and the option of `cutout` and `capture` that it is."""
        low, high = self._subject.bounds
        room = 0.02 * (high - low).norm()
        low, high = low - room, high + room
        self._boxed = gui.add_checkbox(
            "box", False, hint="drag its corners, or click on the object to move its bottom there"
        )
        self._option = gui.add_markdown("", visible=False)
        self._corners = [
            self._client.scene.add_transform_controls(
                f"/box/{name}",
                scale=0.2 * float((high - low).norm()),
                disable_rotations=True,
                position=corner.numpy(),
                visible=False,
            )
            for name, corner in (("low", low), ("high", high))
        ]
        for corner in self._corners:
            corner.on_update(lambda event: self._draw_box())
        self._boxed.on_update(lambda event: self._draw_box())

    def _draw_box(self) -> None:
        shown = self._boxed.value
        corners = np.stack([corner.position for corner in self._corners])
        low, high = corners.min(0), corners.max(0)
        ends = np.array(list(itertools.product((0, 1), repeat=3)))
        edges = [(a, b) for a, b in itertools.combinations(ends, 2) if np.abs(a - b).sum() == 1]
        self._client.scene.add_line_segments(
            "/box/edges",
            low + (high - low) * np.array(edges),
            BOX_COLOR,
            thickness=2.0,
            thickness_units="screen",
            visible=shown,
        )
        for corner in self._corners:
            corner.visible = shown
        values = " ".join(f"{value:.4g}" for value in (*low, *high))
        self._option.content = f"`--box {values}`"
        self._option.visible = shown

    def _go_to(self, view: int) -> None:
        """Move the client's camera to where a photograph was taken."""
        cameras = self._subject.photos.cameras
        pose, middle = cameras.camera_to_world[view], looked_at(cameras)
        forward = -pose[:, 2]
        distance = ((middle - pose[:, 3]) @ forward).clamp_min(1e-3)
        self._shown = view
        with self._client.atomic():
            self._client.camera.position = pose[:, 3].numpy()
            self._client.camera.look_at = (pose[:, 3] + distance * forward).numpy()
            self._client.camera.up_direction = pose[:, 1].numpy()
            self._client.camera.fov = pose_for_viser(cameras, view)[2]

    def _ask(self) -> None:
        camera = self._client.camera
        width, height = max(camera.image_width, 1), max(camera.image_height, 1)
        self._cameras = camera_of(camera.wxyz, camera.position, camera.fov, width, height)
        self._studio.ask(self.viewer, self._cameras, self._look())

    def _look(self) -> Look:
        controls = self._layer, self._exposure, self._ground, self._backdrop, self._denoise
        with self._lock:
            return Look(self._lighting(), *(control.value for control in controls))

    def _relight(self) -> None:
        """The light has changed: the picture, and what arrives at the point."""
        self._ask()
        if self._point is not None:
            self._studio.do(self.viewer, "light at the point", self._gather(self._point))

    def _pick(self, place: tuple[float, float]) -> None:
        """Show what light arrives where the mesh is seen; `place` in widths and heights."""
        size = torch.tensor([float(self._cameras.width), float(self._cameras.height)])
        pixel = (torch.tensor(place, dtype=torch.float32) * size)[None]
        point = point_on_mesh(self._subject, pixel_rays(self._cameras, torch.tensor(0), pixel))
        if point is None:
            return
        if self._boxed.value:
            low = min(self._corners, key=lambda corner: corner.position[2])
            low.position = (*low.position[:2], float(point.position[2]))
            self._draw_box()
            return
        extent = float((self._subject.traced.mesh.vertices.abs()).max())
        self._client.scene.add_icosphere(
            "/point", 0.015 * extent, (255, 80, 60), position=point.position.numpy()
        )
        self._point = point
        self._studio.do(self.viewer, "light at the point", self._gather(point))

    def _gather(self, point: Point) -> Iterator[None]:
        look = self._look()
        light = incident_light(self._subject, point, look.lighting)
        self._arriving.image = _bytes(incident_picture(light, look.exposure))
        self._arriving.visible = True
        yield

    def _make_film(self) -> None:
        if self._film.disabled:
            return
        self._film.disabled, self._progress.value, self._progress.visible = True, 0.0, True
        self._studio.do(self.viewer, "turntable", self._filming(self._cameras, self._look()))

    def _filming(self, cameras: Cameras, look: Look) -> Iterator[None]:
        def report(share: float) -> None:
            self._progress.value = 100 * share

        def send(content: bytes) -> None:
            self._client.send_file_download(f"{self._title}.{kind()}", content)

        try:
            yield from film(self._subject, cameras, look, send, report)
        finally:
            if not self.viewer.gone:
                self._film.disabled, self._progress.visible = False, False

    def _lighting(self) -> Lighting:
        name = self._light.value
        if name not in self._tables:
            dark = torch.zeros(1, 2, 3)
            radiance = dark if name == DARK else self._lights[name].radiance
            self._tables[name] = env.tables(env.EnvMap(radiance))
        turned = rotated(Lighting(self._tables[name]), self._turn.value)
        if not self._sun.value:
            return turned
        direction = direction_at(self._azimuth.value, self._elevation.value)
        return replace(turned, suns=(Sun(direction, (self._sun.value,) * 3),))

    def _show(self, picture: Tensor) -> None:
        self._last = picture
        rgb = picture[..., :3] * picture[..., 3:] + PLAIN * (1 - picture[..., 3:])
        share = self._overlay.value if self._overlay else 0.0
        if share and self._shown is not None:
            rgb = laid_over(rgb, self._subject.photos, self._shown, self._cameras, share)
        values = _bytes(rgb)
        self._client.scene.set_background_image(values, format="jpeg", jpeg_quality=JPEG)

    def _complain(self, line: str) -> None:
        log.warning(line)
        self._client.add_notification("univoxel", line, color="red")

    def _guarded(self, do: Callable[[], None]) -> None:
        """Do something for the client; a mistake becomes one line for it."""
        try:
            do()
        except (UserError, OSError) as error:
            self._complain(str(error))

    def _take_map(self) -> None:
        sent = self._map.value
        light = light_of_bytes(sent.name, sent.content)
        with self._lock:
            self._lights[light.name] = light
            self._tables.pop(light.name, None)
        self._light.options = [*self._lights, DARK]
        self._light.value = light.name
        self._relight()

    def _send_png(self) -> None:
        if self._last is None:
            return
        content = encoded(_bytes(self._last), None)
        self._client.send_file_download(f"{self._title}.png", content)

    def _send_glb(self) -> None:
        surface = simplify(self._subject.traced.mesh, FACES)
        size, albedo_near = self._page.texture_size, self._page.albedo_near
        mesh = bake(self._subject.scene, surface, size, albedo_near)
        self._client.send_file_download(f"{self._title}.glb", glb(mesh, JPEG_QUALITY))


def _bytes(picture: Tensor) -> np.ndarray:
    return (255 * picture + 0.5).clamp(0, 255).byte().numpy()


def light_of_bytes(name: str, content: bytes) -> Light:
    """A map that was sent, as file `name` holds it; the light goes by that name, and so does a
    UserError where it is none."""
    plain = Path(name.replace("\\", "/").replace("\0", "")).name or "map"
    if Path(plain).suffix.lower() not in MAPS:
        raise UserError(f"{plain}: expected an environment map as .hdr or .exr")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"map{Path(plain).suffix.lower()}"
        path.write_bytes(content)
        try:
            return Light(Path(plain).stem, light_of_file(path).radiance)
        except (UserError, OSError) as error:
            raise UserError(str(error).replace(str(path), plain)) from None


def camera_of(wxyz: Any, position: Any, angle: float, width: int, height: int) -> Cameras:
    """viser's camera (+X right, +Y down, +Z ahead; vertical angle in radians) as one of ours."""
    turn = torch.from_numpy(Rotation.from_quat(wxyz, scalar_first=True).as_matrix()).float()
    turn = turn * torch.tensor([1.0, -1.0, -1.0])
    place = torch.tensor([float(v) for v in position])
    focal = height / 2 / math.tan(angle / 2)
    centre = torch.tensor([[width / 2, height / 2]])
    pose = torch.cat([turn, place[:, None]], 1)[None]
    return Cameras(pose, torch.full((1, 2), focal), centre, width, height)


def pose_for_viser(cameras: Cameras, view: int) -> tuple[np.ndarray, np.ndarray, float, float]:
    """wxyz, position, vertical angle in radians and aspect of a view, as viser takes them."""
    pose = cameras.camera_to_world[view]
    turn = (pose[:, :3] * torch.tensor([1.0, -1.0, -1.0])).double().numpy()
    wxyz = Rotation.from_matrix(turn).as_quat(scalar_first=True)
    width, height = cameras.size(view)
    angle = 2 * math.atan(height / 2 / float(cameras.focal[view, 1]))
    return wxyz, pose[:, 3].numpy(), angle, width / height


def laid_over(rgb: Tensor, photos: Photos, view: int, cameras: Cameras, share: float) -> Tensor:
    """A picture [H, W, 3] with a photograph over it, by its share, where the camera stands at it.

    Both look from one point, so pixels of the one lie in the other whichever way they are turned.
    """
    taken = photos.cameras.camera_to_world[view, :, 3]
    extent = taken.norm().clamp_min(1e-6)
    if (cameras.camera_to_world[0, :, 3] - taken).norm() > 1e-2 * extent:
        return rgb
    rays = image_rays(resize(cameras, rgb.shape[1]), 0)
    pixel, depth = project(photos.cameras, view, taken + rays.direction)
    row, column = pixel[:, 1].floor().long(), pixel[:, 0].floor().long()
    columns, rows = photos.cameras.size(view)
    inside = (depth > 0) & (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    where = inside.nonzero()[:, 0]
    color, alpha = photos.pixels(torch.tensor(view), row[where], column[where])
    flat = rgb.reshape(-1, 3).clone()
    over = share * alpha[:, None]
    flat[where] = (1 - over) * flat[where] + over * linear_to_srgb(color)
    return flat.reshape(rgb.shape)
