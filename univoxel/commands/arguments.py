"""Arguments that several commands share: how they are written, and what is refused."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, TypeAlias

from tyro.conf import Positional, UseAppendAction, arg

from univoxel.errors import UserError
from univoxel.names import Downscale

Run: TypeAlias = Annotated[Positional[Path], arg(metavar="RUN")]
AtOnce: TypeAlias = Annotated[int, arg(metavar="N")]
Scheduler: TypeAlias = Annotated[
    str | None, arg(metavar="ADDRESS", help_behavior_hint="(default: this machine)")
]
Scenes: TypeAlias = Annotated[
    Positional[tuple[Path, ...]],
    arg(metavar="SCENE [SCENE ...]", help_behavior_hint="(required)"),
]
Changes: TypeAlias = Annotated[
    UseAppendAction[tuple[str, ...]],
    arg(metavar="FIELD=VALUE", help_behavior_hint="(repeatable)"),
]
Suns: TypeAlias = Annotated[
    UseAppendAction[tuple[tuple[float, ...], ...]],
    arg(metavar="AZIMUTH ELEVATION IRRADIANCE [ANGLE]"),
]
Points: TypeAlias = Annotated[
    UseAppendAction[tuple[tuple[float, float, float, float], ...]],
    arg(metavar="X Y Z INTENSITY"),
]
Minutes: TypeAlias = Annotated[
    float | None, arg(metavar="MINUTES", help_behavior_hint="(default: none)")
]
TimelapseFile: TypeAlias = Annotated[
    str | None, arg(metavar="FILE.gif|FILE.mp4|DIR/", help_behavior_hint="(default: none)")
]
Seed: TypeAlias = Annotated[
    int | None, arg(metavar="N", help_behavior_hint="(default: 0, or that of --config)")
]
ConfigFile: TypeAlias = Annotated[
    Path | None, arg(metavar="FILE", help_behavior_hint="(default: what --preset says)")
]
Megabytes: TypeAlias = Annotated[
    float | None, arg(metavar="MB", help_behavior_hint="(default: no limit)")
]
Host: TypeAlias = Annotated[
    str | None, arg(metavar="ADDRESS", help_behavior_hint="(default: 127.0.0.1)")
]
Port: TypeAlias = Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 8080)")]
JsonFile: TypeAlias = Annotated[
    Path | None, arg(metavar="FILE|-", help_behavior_hint="(default: none)")
]
LightOf: TypeAlias = Annotated[
    str | None, arg(metavar="VIEW", help_behavior_hint="(default: the mean of all)")
]

STDOUT = Path("-")  # as a file for JSON: print it, and it alone


@contextlib.contextmanager
def json_file(asked: Path | None) -> Iterator[Path | None]:
    """The file for a task to write; what was asked to be printed is, at the end."""
    if asked != STDOUT:
        yield asked
        return
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "printed.json"
        yield file
        print(file.read_text(encoding="utf-8"), end="")


def check_minutes(minutes: float | None) -> None:
    """Refuse a limit that is not above 0.

    Raises:
        UserError: it is not.
    """
    if minutes is not None and not minutes > 0:
        raise UserError(f"--minutes must be above 0, got {minutes:g}")


def check_downscale(downscale: Downscale) -> int:
    """The side of the squares of pixels that become one; 0 for auto.

    Raises:
        UserError: it is below 1.
    """
    if downscale == "auto":
        return 0
    if downscale < 1:
        raise UserError(f"--downscale must be at least 1, got {downscale}")
    return downscale
