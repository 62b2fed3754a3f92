"""A run as one web page that needs no other file and no network: the object under lights that turn.

The page draws with three.js (vendor/), from the exported mesh with its textures, the recovered map
and a few others.
"""

from __future__ import annotations

import json
import math
import string
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from univoxel import __version__
from univoxel.assets.bake import bake
from univoxel.assets.gltf import glb
from univoxel.assets.topology import clean, simplify
from univoxel.camera import looked_at
from univoxel.checkpoint import load_checkpoint
from univoxel.errors import UserError
from univoxel.names import MAP_ROWS, TEXTURE_SIZE
from univoxel.page.html import (
    VIEWPORT,
    base64_text,
    document,
    escape,
    paragraph,
    table,
    write_html,
)
from univoxel.page.maps import PHOTOGRAPHED, Light, as_json, light_of_file, usual_lights
from univoxel.page.transfer import Transfer, transfer
from univoxel.records import Mesh
from univoxel.run import photos_of
from univoxel.scene import Scene
from univoxel.training.progress import LOG
from univoxel.verdict import load_verdict

FOLDER = Path(__file__).parent
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
LICENCE = "Drawn with three.js, \u00a9 three.js authors, MIT licence, in the page's source."
SOURCES = {name: f"Map {name!r}: Greg Zaal, Poly Haven, CC0." for name in PHOTOGRAPHED}
KEYS = """1 to 5: layers
Left, Right: turn the light; Space: let it turn
L: dragging turns the light, as it does with Shift
B: backdrop, S: save the picture, 0: first view"""


@dataclass(frozen=True)
class PageOptions:
    """What a page holds.

    Raises:
        UserError: a name of a map is there twice.
    """

    title: str | None = None  # None: the run folder's name
    envmaps: Sequence[str | Path] = ()  # maps to offer before the usual ones
    notes: str = ""  # what to tell first
    measures: Mapping[str, str] = field(default_factory=dict)  # what to tell, by what it is
    faces: int = FACES  # most triangles
    texture_size: int = TEXTURE_SIZE  # texels along a side, a power of 2

    def __post_init__(self) -> None:
        names = [Path(path).stem for path in self.envmaps]
        if len(set(names)) != len(names):
            raise UserError(f"envmap: expected maps of different names, got {names}", "envmap")


SMALL = PageOptions(faces=8_000, texture_size=512)  # for a cell of a notebook


def write_page(run: str | Path, path: str | Path, **options: Any) -> Path:
    """Write a run as one page that opens by double click, without a network; return its path.

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
    write_html(path, text)
    return path


@torch.no_grad()
def page_text(
    run: Path,
    scene: Scene,
    options: PageOptions = PageOptions(),
    seconds: float | None = None,
) -> str:
    """The page of a scene as HTML; errors as of `write_page`.

    Args:
        run: the scene's folder; what is missing of log, trust report and photographs is left out.
        seconds: of training; None: as the log has it, which ends a little earlier.
    """
    lights = lights_of(scene, options)
    title = options.title or run.resolve().name or "univoxel"
    facts = facts_of(run, seconds)
    described = {
        "view": first_view(run),
        "lights": [as_json(light) for light in lights],
    }
    parts = {
        "title": escape(title),
        "facts": escape(" \u00b7 ".join(facts)),
        "about": about(run, options, [light.name for light in lights]),
        "model": base64_text(model(scene, options)),
        "scene": json.dumps(described, separators=(",", ":")).replace("<", "\\u003c"),
        "three": f"/*! {_source('vendor/LICENSE').strip()} */\n{_source('vendor/three.min.js')}",
        "viewer": _source("viewer.js"),
    }
    body = string.Template(_source("page.html").rstrip()).substitute(parts)
    return document(title, _source("page.css"), body, POLICY, f"{VIEWPORT}, viewport-fit=cover")


def model(scene: Scene, options: PageOptions) -> bytes:
    """The scene's surface as GLB with what light reaches its vertices; textures as JPEG."""
    surface = simplify(clean(Mesh(*scene.field.isosurface())), options.faces)
    mesh = bake(scene, surface, options.texture_size)
    return glb(mesh, JPEG_QUALITY, attributes(transfer(mesh, OFFSET * scene.field.voxel_size)))


def attributes(found: Transfer) -> dict[str, Tensor]:
    """A transfer by fours, as names of the page's script: [P, 4] each."""
    padded = torch.nn.functional.pad(found.direct, (0, -found.direct.shape[1] % 4))
    groups = {f"_DIRECT{i}": four for i, four in enumerate(padded.split(4, 1))}
    colors = zip(("_RED", "_GREEN", "_BLUE"), found.bounced.unbind(1), strict=True)
    return {name: four.clamp(-1, 1) for name, four in (groups | dict(colors)).items()}


def lights_of(scene: Scene, options: PageOptions) -> list[Light]:
    """The recovered map where there is one, those given, the usual ones of other names."""
    sky = scene.environment()
    own = [] if sky is None else [Light(RECOVERED, scene.exposed(sky.latlong(MAP_ROWS)))]
    own += [light_of_file(Path(path)) for path in options.envmaps]
    names = {light.name for light in own}
    return own + [light for light in usual_lights() if light.name not in names]


def first_view(run: Path) -> tuple[float, float]:
    """Azimuth and elevation of the first photograph's camera, degrees, about what all look at."""
    try:
        cameras = photos_of(run, split="train").cameras
    except (UserError, OSError):  # moved, or not on this machine
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
    """The page's panel: notes, measures, what photographs leave open, where all comes from."""
    parts = [paragraph(options.notes)] if options.notes else []
    if options.measures:
        rows = [(escape(what), escape(value)) for what, value in options.measures.items()]
        parts.append(f"<h2>Measures on the test views</h2>{table(rows)}")
    trust = run / "trust.txt"
    if trust.is_file():
        text = trust.read_text(encoding="utf-8", errors="replace").strip()
        parts.append(f"<h2>What the photographs leave open</h2>{paragraph(text)}")
    parts.append(f"<h2>Keys</h2><p>{KEYS}</p>")
    sources = [SOURCES[name] for name in lights if name in SOURCES]
    text = " ".join([f"Made by univoxel {__version__}.", LICENCE, *sources])
    return "\n".join([*parts, f"<h2>Sources</h2>{paragraph(text)}"])


def _source(name: str) -> str:
    return (FOLDER / name).read_text(encoding="utf-8")
