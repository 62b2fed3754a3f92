"""Known holes of the installed packages, as pip-audit finds them; what it could not ask is no pass.

pip-audit says "no known vulnerabilities" of packages that its index does not know, and of an index
that it cannot reach for one. Here these are counted.

Usage: python scripts/audit.py PIP_AUDIT. Ends with 0: all were asked for and none has a known hole;
1: some has one; 3: some could not be asked for.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from importlib import metadata
from pathlib import Path

OWN = "univoxel"


def installed() -> list[str]:
    """What is installed, as requirements; 2.13.0+cpu is known to the index as 2.13.0."""
    found = {d.metadata["Name"]: d.version.partition("+")[0] for d in metadata.distributions()}
    return [f"{name}=={version}" for name, version in sorted(found.items()) if name != OWN]


def verdict(report: dict) -> tuple[int, str]:
    """The exit code, and what to say, of what pip-audit wrote."""
    asked = [d for d in report["dependencies"] if "skip_reason" not in d]
    skipped = [d["name"] for d in report["dependencies"] if "skip_reason" in d]
    lines, holes = [], 0
    for dependency in asked:
        for hole in dependency["vulns"]:
            fixed = ", ".join(hole["fix_versions"]) or "no version yet"
            lines.append(
                f"{dependency['name']} {dependency['version']}: {hole['id']}, fixed in {fixed}"
            )
            holes += 1
    lines.append(f"{len(asked)} packages asked for, {holes} known holes")
    if skipped:
        lines.append(
            f"{len(skipped)} not asked for, nothing is known of them: {', '.join(skipped)}"
        )
    return (1 if holes else 3 if skipped or not asked else 0), "\n".join(lines)


def main(program: str) -> int:
    with tempfile.TemporaryDirectory() as folder:
        requirements = Path(folder) / "requirements.txt"
        requirements.write_text("\n".join(installed()) + "\n", encoding="utf-8")
        command = [program, "--requirement", str(requirements), "--no-deps", "--disable-pip"]
        command += ["--format", "json", "--progress-spinner", "off"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    try:
        report = json.loads(done.stdout)
    except json.JSONDecodeError:
        said = done.stderr.strip().splitlines() or ["it said nothing"]
        print(f"nothing was asked for: pip-audit: {said[-1]}")
        return 3
    code, text = verdict(report)
    print(text)
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
