"""What the command line offers: a function per command, which checks and calls one task.

Tasks are imported by the command that runs them: `univoxel --help` does not wait for torch.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from univoxel.commands.installation import demo, doctor
from univoxel.commands.making import batch, capture, cutout, poses, train
from univoxel.commands.using import envmap, evaluate, export, info, inspect, relight, report, view
from univoxel.errors import MissingExtra
from univoxel.parsing import Command, Shell

CLONE = Path(__file__).resolve().parents[2]  # of the repository, where the package stands in one


def completion(shell: Annotated[Positional[Shell], arg(metavar="bash|zsh|fish")], /) -> None:
    """Print what makes a shell complete commands, options and choices.

    For bash, in ~/.bashrc: eval "$(univoxel completion bash)"

    Args:
        shell: that reads it
    """
    from univoxel import parsing

    lab = laboratory() if has_laboratory() else {}
    print(parsing.completion(shell, COMMANDS, lab), end="")


COMMANDS: dict[str, Command] = {
    "capture": capture,
    "poses": poses,
    "cutout": cutout,
    "train": train,
    "batch": batch,
    "eval": evaluate,
    "relight": relight,
    "export": export,
    "view": view,
    "report": report,
    "envmap": envmap,
    "inspect": inspect,
    "info": info,
    "demo": demo,
    "doctor": doctor,
    "completion": completion,
}

# Written `univoxel lab NAME`; without the word, as they once were, they work too
LABORATORY = ("compare", "chart", "stress", "submit")


def has_laboratory() -> bool:
    """Whether the package stands in a clone, beside the folder `lab`, which no wheel holds."""
    return (CLONE / "lab" / "commands.py").is_file()


def laboratory() -> dict[str, Command]:
    """Commands of the laboratory by name.

    Raises:
        MissingExtra: there is none beside the package.
    """
    if not has_laboratory():
        raise MissingExtra(
            f"{', '.join(LABORATORY)} measure the method and are not part of the installed "
            "package: clone the repository, run `make dev` there, and call .venv/bin/univoxel lab"
        )
    return importlib.import_module("lab.commands").COMMANDS
