"""What the command line offers: a function per command, which checks and calls one task.

Tasks are imported by the command that runs them: `univoxel --help` does not wait for torch.
"""

from __future__ import annotations

from typing import Annotated

from tyro.conf import Positional, arg

from univoxel.commands.installation import demo, doctor
from univoxel.commands.laboratory import chart, compare, stress, submit
from univoxel.commands.making import batch, capture, cutout, poses, train
from univoxel.commands.using import envmap, evaluate, export, info, inspect, relight, report, view
from univoxel.parsing import Command, Shell


def completion(shell: Annotated[Positional[Shell], arg(metavar="bash|zsh|fish")], /) -> None:
    """Print what makes a shell complete commands, options and choices.

    For bash, in ~/.bashrc: eval "$(univoxel completion bash)"

    Args:
        shell: that reads it
    """
    from univoxel import parsing

    print(parsing.completion(shell, EVERYDAY, LABORATORY), end="")


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
    "submit": submit,
    "compare": compare,
    "chart": chart,
    "stress": stress,
    "demo": demo,
    "doctor": doctor,
    "completion": completion,
}

# Written `univoxel lab NAME`; without the word, as they once were, they work too
LABORATORY = {name: COMMANDS[name] for name in ("compare", "chart", "stress", "submit")}
EVERYDAY = {name: command for name, command in COMMANDS.items() if name not in LABORATORY}
