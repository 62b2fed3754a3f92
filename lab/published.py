"""The tables of the public data sets, for whoever has those data sets on disk.

OUT/published.md, published.json     a table per data set, and the numbers behind it
OUT/<set>/<scene>/<preset>/          each training, as `lab.runner` keeps it

Protocols: public code of Gao et al. 2024 (Relightable 3D Gaussians, for Synthetic4Relight), Jin et
al. 2023 (TensoIR), Verbin et al. 2022 (Ref-NeRF) and Kuang et al. 2023 (Stanford-ORB).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from lab import plots, runner
from lab.chart import PUBLISHED
from lab.plots import Measure
from lab.record import Outcome, Setting, result_text
from univoxel.core.files import write_text
from univoxel.data import relight_maps
from univoxel.data.research import LIGHT, is_tensoir
from univoxel.data.transforms import is_blender
from univoxel.errors import DataError, ProcessFailed

DEPTH = 4  # levels of folders that are searched: DIR/stanford_orb/blender_HDR/SCENE and one more
SSIM = Measure("nvs_ssim", "novel views, SSIM", True, ".4f")


@dataclass(frozen=True)
class DataSet:
    """A public data set, and how its papers measure."""

    name: str
    looked_for: str  # files that tell its scenes from others
    scenes: int  # that published means are over
    maps: int  # that test views are relit under; 0 if there are none
    columns: tuple[Measure, ...]
    protocol: str
    also: str = "-"  # another name of it, in `chart.PUBLISHED`


SYNTHETIC4RELIGHT = DataSet(
    "Synthetic4Relight",
    "transforms_train.json and test/*_rough.png",
    4,
    2,
    (plots.NVS, SSIM, plots.ALBEDO, plots.ROUGHNESS, plots.RELIT),
    "Protocol: whole frames; albedo and relit images after one scale per colour channel; relit "
    "under envmap6 and envmap12. Deviations: images are cut out by their own alpha instead of the "
    "true one; the scale is the median over all test views; the roughness error is the mean inside "
    "the mask, where public code takes the whole frame, which gives lower numbers.",
    "MII synthetic",
)
TENSOIR = DataSet(
    "TensoIR-Synthetic",
    f"train_000/metadata.json and rgba_{LIGHT}.png",
    4,
    5,
    (plots.NORMAL, plots.NVS, plots.ALBEDO, plots.RELIT),
    "Protocol: whole frames on white; albedo and relit images after one scale per colour channel; "
    "relit under bridge, city, fireplace, forest and night. Deviations: black instead of white; "
    "albedo in sRGB instead of gamma 2.2; the normal error is the mean inside the mask, where "
    "TensoIR takes the whole frame, which gives lower numbers.",
)
SHINY_BLENDER = DataSet(
    "Shiny Blender",
    "transforms_train.json and test/*_normal.png",
    6,
    0,
    (plots.NVS, SSIM, plots.NORMAL),
    "Protocol: whole frames on white; the normal error is weighted by rendered times true alpha. "
    "Deviations: black instead of white; the normal error is the plain mean inside the true mask, "
    "and a pixel without a surface counts as 90 degrees.",
)
STANFORD_ORB = DataSet(
    "Stanford-ORB",
    "blender_HDR/SCENE/transforms_train.json and ground_truth/SCENE",
    42,
    0,
    (plots.NVS,),
    "Protocol: PSNR-H and PSNR-L of novel views and of other scenes' views relit, 512 x 512 "
    "pixels, inside an eroded mask. Deviations: the column is PSNR in sRGB over whole frames at "
    "the size of training, which is close to PSNR-L but not the same. The other columns are left "
    "out because univoxel has no such metrics: `univoxel lab submit` renders what the benchmark's "
    "own scripts/test.py measures.",
)
SETS = (SYNTHETIC4RELIGHT, TENSOIR, SHINY_BLENDER, STANFORD_ORB)


def published(
    folder: Path, out: Path, preset: str = "fast", changes: Sequence[str] = (), jobs: int = 1
) -> Path:
    """Train on every scene of the public data sets in a folder; write out/published.md and .json.

    Args:
        folder: holds scenes up to `DEPTH` folders below; may be a scene itself.
        changes: FIELD=VALUE of the configuration, for all.
        jobs: trainings at once.

    Raises:
        UserError: no such scene, or two of a set have one name; the rest as `runner.run_pairs`.
        ProcessFailed: trainings failed; the tables of the others are written.
    """
    setting = Setting(preset, preset, changes=tuple(changes))
    found = scenes_under(folder)
    maps = {which: [len(relight_maps(scene)) for scene in found[which]] for which in found}
    rows, means, tables, outcomes = [], {}, [], []
    for which, scenes in found.items():
        pairs = [(scene, setting) for scene in scenes]
        done = runner.run_pairs(pairs, out / which.name, at_once=jobs)
        for scene, count, o in zip(scenes, maps[which], done, strict=True):
            row = {"set": which.name, "scene": o.scene, "data": str(scene), "maps": count}
            rows.append(row | {"error": o.error, "measures": o.measures})
        means[which.name] = means_of(which, done)
        tables.append(table(which, done, maps[which]))
        outcomes += done
    record = {"preset": preset, "changes": list(changes), "machine": plots.machine()}
    write_text(out / "published.json", result_text(record | {"rows": rows, "means": means}))
    write_text(out / "published.md", "\n".join(tables))
    if failed := runner.failures(outcomes):
        raise ProcessFailed(f"{failed}; the tables: {out / 'published.md'}")
    return out / "published.md"


def scenes_under(folder: Path) -> dict[DataSet, list[Path]]:
    """Scenes by data set, in the order of `SETS`; a DataError as of `published`."""
    found = [(which, scene) for scene in _scenes(folder, DEPTH) if (which := set_of(scene))]
    if not found:
        wanted = "; ".join(f"{s.name} ({s.looked_for})" for s in SETS)
        raise DataError(f"{folder}: expected scenes of public data sets, got none: {wanted}")
    sets = {s: [scene for which, scene in found if which is s] for s in SETS}
    for which, scenes in sets.items():
        names = [scene.name for scene in scenes]
        if twice := [str(scene) for scene in scenes if names.count(scene.name) > 1]:
            raise DataError(f"{folder}: expected each scene of {which.name} once, got {twice}")
    return {which: scenes for which, scenes in sets.items() if scenes}


def set_of(folder: Path) -> DataSet | None:
    """The public data set that a folder is a scene of, by its files; None for any other folder."""
    if is_tensoir(folder, "train"):
        return TENSOIR if any(folder.glob(f"train_*/rgba_{LIGHT}.png")) else None
    above = folder.resolve().parent
    if above.name == "blender_HDR" and (above.parent / "ground_truth" / folder.name).is_dir():
        return STANFORD_ORB
    if any(folder.glob("test/*_rough.png")):
        return SYNTHETIC4RELIGHT
    return SHINY_BLENDER if any(folder.glob("test/*_normal.png")) else None


def _scenes(folder: Path, depth: int) -> Iterable[Path]:
    """The folder if it has the layout of one of these data sets, or such folders below it."""
    if is_tensoir(folder, "train") or is_blender(folder, "train"):
        yield folder.resolve()
    elif depth and folder.is_dir():
        for inner in sorted(path for path in folder.iterdir() if path.is_dir()):
            yield from _scenes(inner, depth - 1)


def table(which: DataSet, outcomes: Sequence[Outcome], maps: Sequence[int]) -> str:
    """A table in Markdown, and what to know about it; maps: how many each scene is relit under."""
    titles = " | ".join(column.title for column in which.columns)
    lines = [f"## {which.name}\n", f"| scene | {titles} |", "|---|" + "---:|" * len(which.columns)]
    for outcome in outcomes:
        failed = f"failed: {outcome.error}".replace("|", "/").replace("\n", " ")
        cells = failed if outcome.error else _cells(which, outcome.measures)
        lines.append(f"| {outcome.scene} | {cells} |")
    means = _cells(which, means_of(which, outcomes))
    lines.append(f"| mean of {len(outcomes)} (published: of {which.scenes}) | {means} |")
    few = [f"{o.scene} {n}" for o, n in zip(outcomes, maps, strict=True) if n != which.maps]
    if which.maps and few:
        lines.append(f"\nNot relit under {which.maps} maps but fewer or more: {', '.join(few)}.")
    lines.append(f"\n{which.protocol}")
    for paper in (p for p in PUBLISHED if p.where.startswith((which.name, which.also))):
        known = [c for c in which.columns if c.key in paper.measures]
        values = "; ".join(f"{c.title} {paper.measures[c.key]:{c.digits}}" for c in known)
        lines.append(f"\nPublished, {paper.name} ({paper.where}): {values}")
    return "\n".join(lines) + "\n"


def means_of(which: DataSet, outcomes: Sequence[Outcome]) -> dict[str, float | None]:
    """The mean of each column; None if any scene lacks that number."""
    means: dict[str, float | None] = {}
    for key in (column.key for column in which.columns):
        values = [None if o.error else o.measures.get(key) for o in outcomes]
        known = [value for value in values if value is not None]
        means[key] = fmean(known) if len(known) == len(values) else None
    return means


def _cells(which: DataSet, measures: Mapping[str, float | None]) -> str:
    found = [(measures.get(column.key), column.digits) for column in which.columns]
    return " | ".join("-" if value is None else f"{value:{digits}}" for value, digits in found)
