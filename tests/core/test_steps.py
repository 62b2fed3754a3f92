"""What is noted of steps, and what is refused."""

import os
from unittest.mock import Mock

import pytest

from univoxel.core import files
from univoxel.errors import DataError, ExistingFile


def test_a_step_is_done_with_what_it_was_made_of(tmp_path):
    folder = tmp_path / "new"
    made_of = {"files": [("a.jpg", 3)], "size": 1.5}
    assert not files.done(folder, "cut", made_of)
    assert not folder.exists()
    files.finish(folder, "cut", made_of)
    files.finish(folder, "sewn", True)
    assert files.done(folder, "cut", made_of)
    assert files.recorded(folder, "cut") == {"files": [["a.jpg", 3]], "size": 1.5}
    files.forget(folder, "cut", "never done")
    assert not files.done(folder, "cut", made_of)
    assert files.done(folder, "sewn", True)


def test_another_fingerprint_is_refused(tmp_path):
    files.finish(tmp_path, "cut", {"size": 1})
    with pytest.raises(ExistingFile, match="cut was made with other options: choose"):
        files.done(tmp_path, "cut", {"size": 2})
    with pytest.raises(ExistingFile, match="of size 1"):
        files.done(tmp_path, "cut", {}, lambda before: ExistingFile(f"of size {before['size']}"))


def test_a_killed_writer_leaves_the_steps_before(tmp_path, monkeypatch):
    files.finish(tmp_path, "cut", 1)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            files.finish(tmp_path, "sewn", 2)
    assert files.done(tmp_path, "cut", 1)
    assert files.recorded(tmp_path, "sewn") is None


def test_notes_of_another_version_count_where_there_are_no_others(tmp_path):
    files.adopt(tmp_path, {})
    assert list(tmp_path.iterdir()) == []
    files.adopt(tmp_path, {"cut": 1})
    files.adopt(tmp_path, {"cut": 2})
    assert files.done(tmp_path, "cut", 1)


@pytest.mark.parametrize("text", ["{", "[]", "3"])
def test_a_broken_file_is_named(tmp_path, text):
    (tmp_path / files.FILE).write_text(text)
    with pytest.raises(DataError, match=r"steps\.json: "):
        files.recorded(tmp_path, "cut")
