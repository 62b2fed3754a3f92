"""A run as one self-contained web page that shows the object under rotating lights."""

from __future__ import annotations

import json
import math
import string
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from univoxel import __version__, sphere
from univoxel.camera import Cameras, looked_at
from univoxel.core.choices import MAP_ROWS, TEXTURE_SIZE
from univoxel.core.files import write_text
from univoxel.core.html import VIEWPORT, base64_text, document, escape, paragraph, table
from univoxel.core.records import HALF_MAX, AlbedoNear
from univoxel.envmap import read_map
from univoxel.errors import UserError
from univoxel.ops import VisibilityScene
from univoxel.output.mesh import TexturedMesh, bake
from univoxel.output.mesh_files import glb
from univoxel.output.surface import cameras_of, surface_of
from univoxel.output.topology import simplify
from univoxel.run import load_verdict
from univoxel.scene import Scene, load_checkpoint
from univoxel.training.progress import LOG

# How much of a distant light reaches each vertex past the object itself, and by way of it.
#
# The page's renderer casts no shadows. With these numbers beside each vertex the diffuse part has
# soft shadows and colour that neighbours lend each other, under any map, however it is turned: the
# irradiance is a dot product with the map's harmonics.


DEGREE = 4  # of harmonics: shadows as soft as some 40 degrees; 25 numbers a vertex
BOUNCE_DEGREE = 1  # of light by way of the object, which is softer still; 4 numbers a colour
RAYS = 256  # of a vertex, over its half-sphere
BOUNCES = 2  # reflections that are followed, as `univoxel relight` does
VERTICES_AT_ONCE = 1024  # bounds memory


def transfer(mesh: TexturedMesh, offset: float) -> tuple[Tensor, Tensor]:
    """Traced from each vertex of a mesh, with its albedo: direct [P, 25], and bounced [P, 3, 4] by
    colour.

    Irradiance over pi of a vertex is the sum over harmonics of these times the map's numbers.

    Args:
        offset: from the surface, where rays start; world units.

    Source: Sloan, Kautz and Snyder 2002, "Precomputed radiance transfer for real-time rendering
    in dynamic, low-frequency lighting environments", of diffuse surfaces.
    """
    # A seam of the texture doubles vertices: each place once
    places, of_vertex = torch.unique(mesh.vertices, dim=0, return_inverse=True)
    normals = torch.zeros_like(places).index_copy_(0, of_vertex, mesh.normals)
    albedo = torch.zeros_like(places).index_copy_(0, of_vertex, vertex_albedo(mesh))
    faces = of_vertex[mesh.faces.long()]
    direct, vertex, corner, weight = _traced(places, normals, faces, offset)
    few = (BOUNCE_DEGREE + 1) ** 2
    lit = direct[:, None, :few].expand(-1, 3, -1)
    bounced = torch.zeros_like(lit)
    for _ in range(BOUNCES):
        sent = albedo[:, :, None] * (lit + bounced)
        met = torch.einsum("mk,mkcl->mcl", weight, sent[corner])
        bounced = torch.zeros_like(lit).index_add_(0, vertex, met / RAYS)
    return direct[of_vertex], bounced[of_vertex]


def vertex_albedo(mesh: TexturedMesh) -> Tensor:
    """The texture's albedo at the vertices, [P, 3]."""
    size = len(mesh.albedo)
    column, row = (size * mesh.uv[:, 0]).long(), (size * (1 - mesh.uv[:, 1])).long()
    return mesh.albedo[row.clamp(0, size - 1), column.clamp(0, size - 1)]


def _traced(
    places: Tensor, normals: Tensor, faces: Tensor, offset: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Harmonics [P, 25] of the open sky weighted by the cosine over pi, and of M rays that meet the
    object: the vertex [M], the corners [M, 3] of the triangle met, and their weights [M, 3]."""
    visibility = VisibilityScene(places, faces)
    local = sphere.fibonacci_hemisphere(RAYS)
    # Evenly over the disc below them: the cosine is in their density
    radius = (1 - local[:, 2]).sqrt() / (1 - local[:, 2] ** 2).clamp_min(1e-12).sqrt()
    local = torch.cat([local[:, :2] * radius[:, None], local[:, 2:].sqrt()], 1)
    direct, parts = [], []
    for start in range(0, len(places), VERTICES_AT_ONCE):
        some = slice(start, start + VERTICES_AT_ONCE)
        direction = sphere.to_world(local, normals[some, None])
        origin = (places[some] + offset * normals[some])[:, None].expand_as(direction)
        hit = visibility.closest_hit(origin.reshape(-1, 3), direction.reshape(-1, 3))
        open_sky = (hit.face < 0).reshape(len(direction), RAYS)
        harmonics = sphere.real_harmonics(DEGREE, direction)
        direct.append(torch.einsum("pr,prk->pk", open_sky.float(), harmonics) / RAYS)
        met = (hit.face >= 0).nonzero()[:, 0]
        u, v = hit.barycentric[met].unbind(1)
        weight = torch.stack([1 - u - v, u, v], 1)
        parts.append((start + met // RAYS, faces[hit.face[met]], weight))
    vertex, corner, weight = (torch.cat(part) for part in zip(*parts, strict=True))
    return torch.cat(direct), vertex, corner, weight


# The lights that a page offers, and how they are written into it.


BUNDLED = Path(__file__).parent.parent / "example_data" / "tiny" / "envmaps"
PHOTOGRAPHED = ("city", "sunset")
ROWS = 128  # of maps that the page makes itself
MOST_ROWS = 256  # of a map from a file


@dataclass(frozen=True)
class Light:
    """A map with the name that it goes by."""

    name: str
    radiance: Tensor  # [H, 2 H, 3] float32 linear, >= 0


def usual_lights() -> list[Light]:
    """Those that every page offers: two photographed, two made here."""
    photographed = (Light(n, read_map(BUNDLED / f"{n}.hdr").radiance) for n in PHOTOGRAPHED)
    return [Light("studio", studio()), *photographed, Light("overcast", overcast())]


def light_of_file(path: Path) -> Light:
    """A map from a file, averaged to at most MOST_ROWS rows; errors as in `read_map`."""
    radiance = read_map(path).radiance
    return Light(path.stem, _averaged(radiance, min(len(radiance), MOST_ROWS)))


def studio() -> Tensor:
    """Three soft boxes in a dark room: a large key, a wide fill, a strip behind; [ROWS, 2 ROWS, 3].

    A white matte ball is about as bright as white paper on its brightest side.
    """
    direction = sphere.latlong_directions(2 * ROWS)
    room = torch.tensor([0.10, 0.10, 0.105]) * (0.6 + 0.4 * direction[..., 2:])
    radiance = room.expand_as(direction).clone()
    # azimuth, elevation, half width, half height (degrees), radiance, colour
    boxes = (
        (40.0, 38.0, 24.0, 20.0, 5.5, (1.0, 0.97, 0.93)),
        (-75.0, 15.0, 20.0, 32.0, 1.6, (0.92, 0.96, 1.0)),
        (170.0, 25.0, 7.0, 40.0, 5.0, (1.0, 1.0, 1.0)),
    )
    for azimuth, elevation, width, height, power, color in boxes:
        inside = _box(direction, azimuth, elevation, width, height)
        radiance += power * inside[..., None] * torch.tensor(color)
    return _averaged(radiance, ROWS)


def overcast() -> Tensor:
    """A sky of clouds over grey ground, [ROWS, 2 ROWS, 3].

    Source of the sky: CIE standard overcast sky, Moon and Spencer 1942, (1 + 2 sin elevation) / 3.
    """
    up = sphere.latlong_directions(ROWS)[..., 2:]
    sky = 1.1 * (1 + 2 * up.clamp_min(0)) / 3 * torch.tensor([0.93, 0.98, 1.07])
    ground = torch.tensor([0.22, 0.21, 0.20])
    share = torch.sigmoid(up / 0.02)  # the horizon as wide as a texel or two
    return share * sky + (1 - share) * ground


def _averaged(radiance: Tensor, rows: int) -> Tensor:
    """A map of fewer rows: [rows, 2 rows, 3]."""
    size = (rows, 2 * rows)
    return adaptive_avg_pool2d(radiance.movedim(2, 0), size).movedim(0, 2).contiguous()


def _box(
    direction: Tensor, azimuth: float, elevation: float, width: float, height: float
) -> Tensor:
    """How much of a soft box lies in directions [..., 3], in [0, 1]; angles in degrees."""
    phi, up = math.radians(azimuth), math.radians(elevation)
    axes = [
        sphere.direction_at(azimuth, elevation),
        [-math.sin(phi), math.cos(phi), 0.0],
        [-math.sin(up) * math.cos(phi), -math.sin(up) * math.sin(phi), math.cos(up)],
    ]
    forward, right, above = (direction @ direction.new_tensor(axes).T).unbind(-1)
    ahead = forward.clamp_min(1e-3)
    edges = (
        1 - (right / ahead).abs() / math.tan(math.radians(width)),
        1 - (above / ahead).abs() / math.tan(math.radians(height)),
    )
    inside = torch.stack([(edge / 0.15).clamp(0, 1) for edge in edges]).prod(0)
    # A diffuser is brightest in its middle
    return torch.where(forward > 0.05, inside * (0.75 + 0.25 * edges[0].clamp(0, 1)), 0.0)


def harmonics(radiance: Tensor) -> Tensor:
    """[25, 3]: integrals over the sphere of a map [H, 2 H, 3] times each real harmonic."""
    height, width, _ = radiance.shape
    basis = sphere.real_harmonics(DEGREE, sphere.latlong_directions(height))
    weighted = radiance * sphere.texel_solid_angles(height, width)[..., None]
    return torch.einsum("hwk,hwc->kc", basis, weighted)


def as_json(light: Light) -> dict[str, Any]:
    """A map as the page's script reads it: halves, row 0 on top, and its harmonics."""
    stored = light.radiance.clamp_max(HALF_MAX)
    return {
        "name": light.name,
        "height": len(stored),
        "texels": base64_text(stored.half().numpy().astype("<f2").tobytes()),
        "harmonics": [[round(x, 6) for x in row] for row in harmonics(stored).tolist()],
    }


# The page draws with three.js (web/vendor/), from the exported mesh with its textures, the
# recovered map and a few others.


FOLDER = Path(__file__).parent / "web"
RECOVERED = "recovered"  # name of the light that the photographs were taken in
OFFSET = 0.1  # voxels, from the surface, where rays start
JPEG_QUALITY = 92  # of textures
START = (30.0, 18.0)  # azimuth and elevation of the first view, degrees, where photographs lack
ELEVATIONS = (5.0, 40.0)  # that a first view is brought to, degrees
FACES = 12_000  # most triangles: the texture holds what they are too coarse for
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data: blob:; connect-src data: blob:"
)
LICENCE = (
    "Drawn with three.js (\u00a9 three.js authors; its MIT licence is in the source of the page)."
)
SOURCES = {name: f"Map {name!r}: Greg Zaal, Poly Haven, CC0." for name in PHOTOGRAPHED}
KEYS = """1 to 5: show a layer
Left, Right: rotate the light; Space: rotate it continuously
L, or hold Shift: dragging rotates the light instead of the view
B: show the backdrop; S: save the image; 0: return to the first view"""


@dataclass(frozen=True)
class PageOptions:
    """What a page contains.

    Raises:
        UserError: two maps have the same name.
    """

    title: str | None = None  # None: the name of the run's folder
    envmaps: Sequence[str | Path] = ()  # maps to offer before the built-in ones
    notes: str = ""  # text at the beginning of the page
    measures: Mapping[str, str] = field(default_factory=dict)  # metrics to show, by their names
    faces: int = FACES  # maximum number of triangles
    texture_size: int = TEXTURE_SIZE  # width of the square textures in texels, a power of 2
    albedo_near: AlbedoNear | None = None  # source of the albedo; None: the field

    def __post_init__(self) -> None:
        names = [Path(path).stem for path in self.envmaps]
        if len(set(names)) != len(names):
            raise UserError(f"envmap: expected maps with different names, got {names}", "envmap")


SMALL = PageOptions(faces=8_000, texture_size=512)  # for a cell of a notebook


def write_page(run: str | Path, path: str | Path, **options: Any) -> Path:
    """Write a run as a self-contained web page; return its path.

    Args:
        run: folder of the trained run.
        path: .html file, written whole or not at all.
        options: fields of `PageOptions`.

    Raises:
        UserError: the run or a map cannot be used, or there is no surface.
        OSError: a file cannot be read or written.
    """
    run, path = Path(run), Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise UserError(f"html: expected a file that ends in .html, got {path}", "html")
    scene, state = load_checkpoint(run)
    text = page_text(run, scene, PageOptions(**options), state.get("seconds"))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, text)
    return path


@torch.no_grad()
def page_text(
    run: Path, scene: Scene, options: PageOptions = PageOptions(), seconds: float | None = None
) -> str:
    """The page of a scene as HTML; errors as in `write_page`.

    Args:
        run: the scene's folder; what is missing of log, trust report and photographs is left out.
        seconds: of training; None: as the log has it, which ends a little earlier.
    """
    lights, cameras = lights_of(scene, options), cameras_of(scene, run)
    title = options.title or run.resolve().name or "univoxel"
    facts = facts_of(run, seconds)
    described = {"view": first_view(cameras), "lights": [as_json(light) for light in lights]}
    parts = {
        "title": escape(title),
        "facts": escape(" \u00b7 ".join(facts)),
        "about": about(run, options, [light.name for light in lights]),
        "model": base64_text(model(scene, options, cameras)),
        "scene": json.dumps(described, separators=(",", ":")).replace("<", "\\u003c"),
        "three": f"/*! {_source('vendor/LICENSE').strip()} */\n{_source('vendor/three.min.js')}",
        "viewer": _source("viewer.js"),
    }
    body = string.Template(_source("page.html").rstrip()).substitute(parts)
    return document(title, _source("page.css"), body, POLICY, f"{VIEWPORT}, viewport-fit=cover")


def model(scene: Scene, options: PageOptions, cameras: Cameras | None) -> bytes:
    """The scene's surface as GLB with what light reaches its vertices; textures as JPEG."""
    surface = simplify(surface_of(scene, cameras), options.faces)
    textured = bake(scene, surface, options.texture_size, options.albedo_near)
    mesh = replace(textured, seen=None)  # nothing reads it
    return glb(mesh, JPEG_QUALITY, attributes(*transfer(mesh, OFFSET * scene.field.voxel_size)))


def attributes(direct: Tensor, bounced: Tensor) -> dict[str, Tensor]:
    """What `transfer` gives, by fours, as names of the page's script: [P, 4] each."""
    padded = torch.nn.functional.pad(direct, (0, -direct.shape[1] % 4))
    groups = {f"_DIRECT{i}": four for i, four in enumerate(padded.split(4, 1))}
    colors = zip(("_RED", "_GREEN", "_BLUE"), bounced.unbind(1), strict=True)
    return {name: four.clamp(-1, 1) for name, four in (groups | dict(colors)).items()}


def lights_of(scene: Scene, options: PageOptions) -> list[Light]:
    """The recovered map if there is one, those given, the usual ones of other names."""
    sky = scene.environment()
    own = [] if sky is None else [Light(RECOVERED, scene.exposed(sky.latlong(MAP_ROWS)))]
    own += [light_of_file(Path(path)) for path in options.envmaps]
    names = {light.name for light in own}
    return own + [light for light in usual_lights() if light.name not in names]


def first_view(cameras: Cameras | None) -> tuple[float, float]:
    """Azimuth and elevation of the first photograph's camera, degrees, about what all look at."""
    if cameras is None:
        return START
    x, y, z = (cameras.camera_to_world[0, :, 3] - looked_at(cameras)).tolist()
    low, high = ELEVATIONS
    elevation = math.degrees(math.atan2(z, math.hypot(x, y)))
    return round(math.degrees(math.atan2(y, x)), 2), round(min(max(elevation, low), high), 2)


def facts_of(run: Path, total: float | None = None) -> list[str]:
    """How the run came out and what its log tells, in a few words each; empty where neither is.

    Args:
        total: seconds of training; None: up to the log's last line.
    """
    verdict = load_verdict(run)
    known = [] if verdict is None else [f"result: {verdict.word}"]
    try:
        lines = [json.loads(line) for line in (run / LOG).read_text("utf-8").splitlines()]
        seconds = [line["seconds"] for line in lines]
        quality = [line["held_out_psnr"] for line in lines if line["held_out_psnr"] is not None]
        took = total or seconds[-1]
        known.append(f"trained in {took:.0f} s on the CPU")
        return known + ([f"validation {quality[-1]:.1f} dB"] if quality else [])
    except (OSError, ValueError, LookupError, TypeError):  # only told of where it can be read
        return known


def about(run: Path, options: PageOptions, lights: Sequence[str]) -> str:
    """The page's panel: notes, metrics, result and expected errors, keys, sources."""
    parts = [paragraph(options.notes)] if options.notes else []
    if options.measures:
        rows = [(escape(what), escape(value)) for what, value in options.measures.items()]
        parts.append(f"<h2>Metrics on the test views</h2>{table(rows)}")
    trust = run / "trust.txt"
    if trust.is_file():
        text = trust.read_text(encoding="utf-8", errors="replace").strip()
        parts.append(f"<h2>Result and expected errors</h2>{paragraph(text)}")
    parts.append(f"<h2>Keys</h2><p>{KEYS}</p>")
    sources = [SOURCES[name] for name in lights if name in SOURCES]
    text = " ".join([f"Made by univoxel {__version__}.", LICENCE, *sources])
    return "\n".join([*parts, f"<h2>Sources</h2>{paragraph(text)}"])


def _source(name: str) -> str:
    return (FOLDER / name).read_text(encoding="utf-8")
