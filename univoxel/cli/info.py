"""Parts of a trained model with their parameters and bytes, and the sizes chosen for it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from univoxel.cli.parsing import STDOUT, File, JsonFile, Run, json_file, takes, written
from univoxel.core import log
from univoxel.core.files import write_json
from univoxel.errors import UserError

if TYPE_CHECKING:
    import numpy as np
    from rich.table import Table

    from univoxel.scene import Scene


# Beginning of a tensor's name in the file: the part it belongs to. The first that fits counts.
PARTS = {
    "field.sdf": "distances",
    "field.feature": "features",
    "material.": "material head",
    "radiance.": "radiance head",
    "light.": "light",
    "mirrored.": "mirrored light",
    "sky.": "map",
    "views.": "views",
}
# Not learned: where the numbers of a grid belong, and directions that are computed
INDICES = ("field.feature_rows", "field.sdf_rows", "field.sdf_side")
INDICES += ("sky.direction", "radiance.direction_rows")
TILE, MARGIN, BAR = 260, 12, 26  # pixels of the picture
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#999999", "#f0e442")


@dataclass(frozen=True)
class InfoOptions:
    run: Run
    """folder of a trained run"""
    json: JsonFile = None
    """write the numbers to a file as JSON; use - to print them instead of the tables"""
    picture: Annotated[File | None, written("FILE.png", "none")] = None
    """image to write, which shows where features are stored and the size of each part"""


@takes(InfoOptions)
def command(asked: InfoOptions) -> None:
    """Show the verdict, the parts and the sizes of a run.

    Lists the parameters and bytes of each part, and the epipolar error of points that are matched
    between the photographs.
    """
    import rich
    from rich.text import Text

    with json_file(asked.json) as file:
        found = info(asked.run, json=file, picture=asked.picture)
    if asked.json == STDOUT:
        return
    for table in tables(found):
        rich.print(table)
    for choice in found["chosen"]:
        rich.print(Text(choice["said"]))


@takes(InfoOptions)
def info(asked: InfoOptions) -> dict[str, Any]:
    """Sizes of the model of a run, and the epipolar error of its cameras.

    Parameters are the learned numbers in the file: distances and features of the stored nodes,
    weights and light. Row numbers and directions of the map count as bytes only.

    Returns:
        JSON: `parameters`, `bytes`, `parts` (name: parameters and bytes), `grid` (size, voxel_size,
        nodes, and shares of them: with distances, with features), `channels`,
        `material_channels`, `hidden`, `lobes` (None if there are none), `chosen`: what,
        before, after, cost in dB and why; `cameras`, see `camera_check`; `said`,
        how training came out in words, `result`, as verdict.json has it, None if it has not.

    Raises:
        UserError: no model there, or one that cannot be read.
        OSError: a file cannot be written.
    """
    from univoxel.data.images import write_png
    from univoxel.run import as_json, load_verdict
    from univoxel.scene import FILE, load_checkpoint

    run = Path(asked.run)
    json, picture = (None if p is None else Path(p) for p in (asked.json, asked.picture))
    if picture is not None and picture.suffix.lower() != ".png":
        raise UserError(f"picture: expected a .png file, got {picture}", "picture")
    scene, state = load_checkpoint(run)
    found = facts(scene, parts(run), state)
    found["bytes"] = (run / FILE).stat().st_size
    found["cameras"] = camera_check(scene, run)
    verdict = load_verdict(run)
    unknown = "Result: unfinished, because training has not ended; to finish it, use train --resume"
    if (run / "trust.txt").exists():
        unknown = "Result: unknown, because the run was trained by a version before 0.3"
    found["said"] = unknown if verdict is None else verdict.sentence()
    found["result"] = None if verdict is None else as_json(verdict)
    for path in (json, picture):
        if path:
            path.parent.mkdir(parents=True, exist_ok=True)
    if json:
        write_json(json, found)
    if picture:
        write_png(picture, capacity_picture(scene, found))
    return found


def camera_check(scene: Scene, run: Path) -> dict[str, Any] | None:
    """Epipolar error of points that are matched between the photographs of a run: `matches`,
    `refined`, and `given` and `used` (median and 90 %, pixels) for the given cameras and those of
    the scene. None if too few points match, or the photographs cannot be read."""
    from univoxel.preparation.hull import mask_distances
    from univoxel.preparation.matches import agreement, find_matches
    from univoxel.run import photos_of

    try:
        photos = photos_of(run, split="train")
        used = scene.registered(photos).cameras
    except UserError as error:
        log.info("the epipolar error is unknown: %s", error)
        return None
    matches = find_matches(photos, mask_distances(photos.coverage(), photos.cameras))
    given, after = (agreement(cameras, matches) for cameras in (photos.cameras, used))
    if given is None or after is None:
        return None
    return {
        "matches": len(matches),
        "refined": scene.poses is not None,
        "given": {"median": given.median, "most": given.most},
        "used": {"median": after.median, "most": after.most},
    }


def parts(run: Path) -> dict[str, dict[str, int]]:
    """What every part takes up in the file, the largest first: parameters, which are learned, and
    bytes, with those of the numbers that say where they belong."""
    from safetensors import safe_open

    from univoxel.scene import FILE

    found: dict[str, dict[str, int]] = {}
    with safe_open(run / FILE, "pt") as file:
        for name in file.keys():
            tensor = file.get_tensor(name)
            which = next((p for start, p in PARTS.items() if name.startswith(start)), "other")
            part = found.setdefault(which, {"parameters": 0, "bytes": 0})
            part["parameters"] += 0 if name in INDICES else tensor.numel()
            part["bytes"] += tensor.numel() * tensor.element_size()
    return dict(sorted(found.items(), key=lambda item: -item[1]["bytes"]))


def facts(scene: Scene, parts: dict[str, dict[str, int]], state: dict[str, Any]) -> dict[str, Any]:
    """The numbers, see `info`."""
    from univoxel.lights import LocalSG

    grid, cfg = scene.field.grid, scene.cfg
    features = scene.field.occupied()
    return {
        "parameters": sum(p["parameters"] for p in parts.values()),
        "bytes": sum(p["bytes"] for p in parts.values()),
        "parts": parts,
        "grid": {
            "size": list(grid.size),
            "voxel_size": grid.voxel_size,
            "nodes": grid.nodes_count,
            "share_with_distance": parts["distances"]["parameters"] / grid.nodes_count,
            "share_with_features": features.float().mean().item(),
        },
        "channels": cfg.channels,
        "material_channels": cfg.material_channels,
        "hidden": cfg.hidden,
        "lobes": scene.light.config.lobes if isinstance(scene.light, LocalSG) else None,
        "chosen": state.get("chosen", []),
    }


def tables(found: dict[str, Any]) -> Iterable[Table | str]:
    """The facts as the command prints them."""
    from rich.table import Table

    yield found["said"]
    table = Table("part", "parameters", "bytes", "share", title="Model")
    for column in table.columns[1:]:
        column.justify = "right"
    whole = sum(p["bytes"] for p in found["parts"].values())
    for name, part in found["parts"].items():
        share = f"{part['bytes'] / whole:.1%}"
        table.add_row(name, f"{part['parameters']:,}", f"{part['bytes']:,}", share)
    table.add_section()
    table.add_row("all", f"{found['parameters']:,}", f"{found['bytes']:,}", "with the file header")
    yield table
    grid = found["grid"]
    table = Table("size", "value", title="Sizes")
    table.columns[1].justify = "right"
    x, y, z = grid["size"]
    table.add_row("nodes of the grid", f"{x} x {y} x {z}")
    table.add_row("voxel, world units", f"{grid['voxel_size']:.4g}")
    table.add_row("nodes that store a distance", f"{grid['share_with_distance']:.1%}")
    table.add_row("nodes with features", f"{grid['share_with_features']:.1%}")
    table.add_row("feature channels", f"{found['channels']}")
    table.add_row("features used for materials", f"{found['material_channels']}")
    table.add_row("hidden units per layer", f"{found['hidden']}")
    table.add_row("light lobes", "-" if found["lobes"] is None else f"{found['lobes']}")
    yield table
    if found["cameras"] is None:
        return
    title = "Epipolar error of matched points, in pixels"
    table = Table("cameras", "median", "90 %", title=title)
    for column in table.columns[1:]:
        column.justify = "right"
    for name, key in (("as given", "given"), ("as refined", "used")):
        if key == "given" or found["cameras"]["refined"]:
            off = found["cameras"][key]
            table.add_row(name, f"{off['median']:.2f}", f"{off['most']:.2f}")
    table.add_section()
    table.add_row("matches", f"{found['cameras']['matches']}", "")
    yield table


def capacity_picture(scene: Scene, found: dict[str, Any]) -> np.ndarray:
    """Where the capacity went: [H, W, 3] in [0, 1].

    Nodes with features, counted along each axis of the grid, the brightest where there are most;
    under them a bar of the file's bytes by part.
    """
    import numpy as np
    from PIL import Image, ImageDraw, ImageFont

    from univoxel.render.pictures import heat

    used = scene.field.occupied()
    counts = [used.sum(axis).float() for axis in range(3)]
    most = max(max(float(c.max()) for c in counts), 1.0)
    longest = max(used.shape)
    width = 3 * TILE + 4 * MARGIN
    lines = len(found["parts"])
    height = TILE + BAR + 5 * MARGIN + 2 * MARGIN * lines
    image = Image.new("RGB", (width, height), "white")
    drawing, font = ImageDraw.Draw(image), ImageFont.load_default(13)
    for k, (count, name) in enumerate(zip(counts, ("along x", "along y", "along z"), strict=True)):
        tile = (255 * heat(count.T.flip(0), most)).astype(np.uint8)  # the second axis goes up
        high, wide = (max(1, round(TILE * n / longest)) for n in tile.shape[:2])
        left, top = MARGIN + k * (TILE + MARGIN), 2 * MARGIN + 4
        picture = Image.fromarray(tile).resize((wide, high), Image.Resampling.NEAREST)
        image.paste(picture, (left, top))
        drawing.text((left, 4), f"nodes with features {name}", fill="black", font=font)
    top, left = TILE + 3 * MARGIN, MARGIN
    whole = sum(part["bytes"] for part in found["parts"].values())
    for k, (name, part) in enumerate(found["parts"].items()):
        share = part["bytes"] / whole
        right = left + share * (width - 2 * MARGIN)
        drawing.rectangle((left, top, right, top + BAR), fill=COLORS[k % len(COLORS)])
        y = top + BAR + MARGIN + 2 * MARGIN * k
        drawing.rectangle((MARGIN, y, MARGIN + 12, y + 12), fill=COLORS[k % len(COLORS)])
        text = f"{name}: {part['parameters']:,} parameters, {part['bytes']:,} bytes, {share:.1%}"
        drawing.text((MARGIN + 20, y - 2), text, fill="black", font=font)
        left = right
    return np.asarray(image, np.float32) / 255
