"""Commands about the installation: demo, doctor."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import rich
from tyro.conf import arg

from univoxel.commands.arguments import STDOUT, JsonFile, json_file


def demo(out: Annotated[Path, arg(metavar="DIR")] = Path("univoxel-demo")) -> None:
    """Train, evaluate and relight the bundled scene, in minutes.

    Args:
        out: folder for everything it writes; the page to open is DIR/index.html
    """
    from univoxel.tasks import demo as task

    print(task.demo(out))


def doctor(
    json: JsonFile = None,
) -> None:
    """Look at this installation and machine, and say what they lack.

    Processor and the kernels built for it, Embree, torch, OpenMP, threads, memory, extras. Ends
    with exit code 2 where training would be refused.

    Args:
        json: file for the findings; - prints them in place of the table
    """
    from univoxel.tasks import doctor as task

    with json_file(json) as file:
        findings = task.doctor(json=file)
    if json != STDOUT:
        rich.print(task.table(findings))
    task.check(findings)
