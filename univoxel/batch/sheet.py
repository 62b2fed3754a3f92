"""A batch as one page: a picture of each scene, what was measured, how sure it is, what failed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from PIL import Image

from univoxel.batch.results import SceneResult
from univoxel.batch.scenes import LOGS
from univoxel.capture.project import Project
from univoxel.page.html import DARK_STYLE, document, escape, image, paragraph, table, write_html

TILE = 120  # pixels of the longer side
COLUMNS = {  # measures that the page shows, by key, with their digits
    "nvs_psnr": ("novel views, dB", 1),
    "albedo_psnr_3ch": ("albedo, dB", 1),
    "roughness_mse": ("roughness, MSE", 3),
    "relit_psnr": ("relit, dB", 1),
    "normal_mae_deg": ("normals, degrees", 1),
}
WORSE_FIRST = {"failed": 0, "left": 1, "done": 2}

_STYLE = f"""{DARK_STYLE}
table {{ border-collapse: collapse }}
th, td {{ padding: 4px 12px; text-align: right; border-bottom: 1px solid #444 }}
th {{ position: sticky; top: 0; background: #202020 }}
:is(th, td):is(:nth-child(2), :nth-child(3)), td:last-child {{ text-align: left }}
td img {{ display: block }}
a {{ color: #9cf }}
.failed td {{ color: #ffb347 }}"""


def write_sheet(results: Sequence[SceneResult], out: Path) -> Path:
    """Write out/index.html, which holds its pictures; return it. Failed scenes come first.

    Raises:
        OSError: it cannot be written.
    """
    shown = [key for key in COLUMNS if any(r.measures.get(key) is not None for r in results)]
    heads = ["", "scene", "verdict", *(COLUMNS[key][0] for key in shown)]
    heads += ["doubt of albedo", "of roughness", "training", "all", ""]
    ordered = sorted(results, key=lambda r: (WORSE_FIRST[r.state], r.name))
    counts = [(state, sum(r.state == state for r in results)) for state in WORSE_FIRST]
    about = ", ".join(f"{count} {state}" for state, count in counts if count)
    rows = table((_row(r, shown, out) for r in ordered), heads, [r.state for r in ordered])
    title, page = out.absolute().name, out / "index.html"
    body = f"<h1>{escape(title)}</h1>\n{paragraph(about)}\n{rows}"
    write_html(page, document(title, _STYLE, body))
    return page


def _row(result: SceneResult, shown: Sequence[str], out: Path) -> list[str]:
    project = Project(out / result.folder)
    cells = [_thumbnail(project.run / "preview.png"), _link(project.page, result.name, out)]
    cells.append(result.verdict or "-")
    cells += [_number(result.measures.get(key), COLUMNS[key][1]) for key in shown]
    cells += [_number(result.doubts.get(key), 2) for key in ("doubt_albedo", "doubt_roughness")]
    whole = sum(result.seconds.values()) if result.seconds else None
    cells += [_seconds(result.seconds.get("train")), _seconds(whole)]
    output = _link(out / LOGS / f"{result.name}.txt", "what it said", out)
    return [*cells, f"{escape(result.error)} {output}"]


def _link(path: Path, text: str, out: Path) -> str:
    """The text, as a link where there is something."""
    said = escape(text)
    if not path.exists():
        return said
    return f'<a href="{quote(path.relative_to(out).as_posix())}">{said}</a>'


def _number(value: float | int | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f} s"


def _thumbnail(path: Path) -> str:
    """The left of a run's preview, its picture of the object, as an image in the page."""
    try:
        with Image.open(path) as picture:
            small = picture.convert("RGB")
    except (OSError, ValueError):  # none yet
        return ""
    small.thumbnail((TILE * 4, TILE), Image.Resampling.BOX)
    return image(small)
