"""What is said of packages' known holes: those that were not asked for are no pass."""

import runpy
from pathlib import Path

import pytest

verdict = runpy.run_path(str(Path(__file__).parent.parent / "scripts" / "audit.py"))["verdict"]
HOLE = {"id": "PYSEC-1", "fix_versions": ["2.0"], "aliases": [], "description": ""}
SOUND = {"name": "a", "version": "1", "vulns": []}
HOLED = {"name": "b", "version": "1", "vulns": [HOLE]}
UNKNOWN = {"name": "c", "skip_reason": "not found"}


@pytest.mark.parametrize(
    ("dependencies", "code", "said"),
    [
        ([SOUND], 0, "1 packages asked for, 0 known holes"),
        ([SOUND, HOLED], 1, "b 1: PYSEC-1, fixed in 2.0"),
        ([SOUND, UNKNOWN], 3, "1 not asked for, nothing is known of them: c"),
        ([HOLED, UNKNOWN], 1, "nothing is known of them: c"),
        ([], 3, "0 packages asked for"),
    ],
)
def test_verdict(dependencies, code, said):
    found, text = verdict({"dependencies": dependencies})
    assert found == code
    assert said in text
