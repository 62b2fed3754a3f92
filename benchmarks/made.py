"""When, and of which commit, a result is: the first keys of every file in results/."""

from __future__ import annotations

import subprocess
from datetime import date
from pathlib import Path


def made() -> dict[str, str]:
    """Today's date and the commit, with -dirty where files differ from it."""
    command = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    told = subprocess.run(
        command, cwd=Path(__file__).parent, capture_output=True, text=True, check=False
    )
    return {"date": date.today().isoformat(), "commit": told.stdout.strip() or "unknown"}
