"""Pages against results, code and rules: the checks of scripts/docs, and that they can fail."""

import re
import shutil
from functools import partial
from pathlib import Path

import doc_blocks
import doc_names
import doc_prose
import doc_python
import doc_reference
import doc_tables
import doc_truth
import doc_words
import pytest

import univoxel

ROOT = Path(__file__).parent.parent


def test_pages_agree_with_results_and_code():
    assert doc_blocks.update(ROOT, write=False) == []
    assert doc_blocks.unused(ROOT) == []
    assert doc_prose.faults(ROOT) == []
    assert doc_names.faults(ROOT) == []
    assert doc_truth.faults(ROOT) == []
    assert doc_words.faults(ROOT) == []


def test_every_field_of_the_configuration_has_a_meaning():
    rows = re.findall(r"^\| `(\w+)` \|.*\| (.*) \|$", doc_reference.configuration(), re.MULTILINE)
    assert len(rows) > 100
    assert [name for name, meaning in rows if not meaning.strip() or "---" in meaning] == []


@pytest.fixture
def copy(tmp_path):
    """The README and what its blocks are made of."""
    shutil.copytree(ROOT / "benchmarks/results", tmp_path / "benchmarks/results")
    shutil.copy(ROOT / "README.md", tmp_path)
    return tmp_path


CHART = "benchmarks/results/chart.json"
RESULT = r'"setting": "fast", "measures": \{"nvs_psnr": \d+'
DIFFERS = r"README\.md:\d+: block chart\.json:small differs"


@pytest.mark.parametrize(
    ("file", "pattern", "new", "found"),
    [
        ("README.md", r"(\| sneaker \| \d+ \| )\d+\.\d", r"\g<1>99.9", DIFFERS),
        (CHART, RESULT, r"\g<0>1", DIFFERS),
        ("README.md", "<!-- end chart.json:small -->", "", ".*begins or ends alone"),
    ],
)
def test_blocks_that_are_not_those_of_results_are_found(copy, file, pattern, new, found):
    assert doc_blocks.update(copy, write=False) == []
    path = copy / file
    text = path.read_text()
    path.write_text(re.sub(pattern, new, text))
    (fault,) = doc_blocks.update(copy, write=False)
    assert re.match(found, fault)
    if "sneaker" in pattern:
        assert doc_blocks.update(copy, write=True) == []
        assert path.read_text() == text


def test_a_result_that_no_page_shows_is_found(copy):
    assert "benchmarks/results/ops.json: no page shows it" in doc_blocks.unused(copy)
    assert "benchmarks/results/chart.json: no page shows it" not in doc_blocks.unused(copy)


def test_figures_of_several_versions_are_found(tmp_path):
    results = tmp_path / "benchmarks/results"
    (results / "ideas").mkdir(parents=True)
    for name, commit in (("a", "1"), ("b", "1"), ("ideas/c", "2")):
        (results / f"{name}.json").write_text(f'{{"commit": "{commit}"}}')
    assert doc_blocks.several_versions(tmp_path) == []
    (results / "d.json").write_text('{"commit": "3"}')
    (fault,) = doc_blocks.several_versions(tmp_path)
    assert fault.endswith("figures are of several versions: 1: a, b; 3: d")


def test_tables_take_their_part_of_a_file_and_say_where_it_was_measured():
    record = {"date": "2026-01-01", "commit": "b", "machine": {"processor": "P"}}
    assert doc_tables.version(record) == "2026-01-01, commit b, P"
    with pytest.raises(ValueError, match="runs mix the commits a, b"):
        doc_tables.check_one_version(record | {"runs": {"x": {"commit": "a"}, "y": record}})

    def settings(table: str) -> list[str]:
        return re.findall(r"`([\w-]+)` \|", table)

    sizes = {
        f"ball draft {name}": {"model_bytes": 1, "nvs_psnr": 1}
        for name in ("dense", "hash", "adaptive")
    }
    capacity = doc_tables.KINDS["capacity.json"]
    assert settings(capacity({"runs": sizes}, "")) == ["hash", "adaptive"]
    assert settings(capacity({"runs": sizes}, "fields")) == ["dense", "hash"]
    lights = {f"tiny draft {x} fixed none": {"nvs_psnr": n} for n, x in enumerate(("sg", "hybrid"))}
    varying = doc_tables.KINDS["varying.json"]({"runs": lights}, "hybrid")
    assert varying.endswith("| unchanged | `none` | 1.0 |")


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("It gains 0.3 dB.", ["0.3 dB"]),
        ("It takes 4 to 9 seconds, 20% of all.", ["4 to 9 seconds", "20%"]),
        ("2 x faster, at 400 x 400 pixels, with Python 3.11", ["2 x"]),
        ("In code `0.3 dB` and\n\n    0.3 dB\n\n```\n0.3 dB\n```\n", []),
        ("<!-- begin x -->\n0.3 dB\n<!-- end x -->", []),
        ("[a 3 dB link](page.md#3-db)", ["3 dB"]),
    ],
)
def test_measured_numbers_are_found_outside_of_blocks_and_code(text, found):
    assert [number for _, number in doc_prose.measured(text)] == found


@pytest.mark.parametrize(("pattern", "instead", "bad"), doc_words.MARKERS + doc_words.LABELS)
def test_every_marker_is_refused(pattern, instead, bad):
    assert any(slip.endswith(instead) for slip in doc_words.slips(bad)), pattern


def test_good_words_pass():
    good = "What is a mask? Leave it alone. If there is none, the optimiser keeps `as of`."
    assert doc_words.slips(good) == doc_words.of_page(good + "\n\n    anew\n\n*doubt*\n") == []
    assert [line for line, _ in doc_words.of_page("One.\n\nThe log\nsays it.\n")] == [3]
    found = doc_words.texts('"""A doubt."""\ndef command(): "Goes on."\nf"{x} stood there"')
    assert {line for line, text in found if doc_words.slips(text)} == {2, 3}


LONG = "word " * 21


def leaves_docs(link):
    """The link, if a page in a folder of docs may not have it."""
    return [link] if doc_prose.leaves_docs(ROOT / "docs/guide/page.md", link, ROOT) else []


@pytest.mark.parametrize(
    ("check", "page", "count"),
    [
        (doc_names.commands, "    univoxel trian x --out y\n", 1),
        (doc_names.commands, "    univoxel train x --out y --presett fast\n", 1),
        (doc_names.commands, "    univoxel train x --out y\n    univoxel --version\n", 0),
        (doc_names.spans, "Look at `univoxel trian`, at `univoxel train --presett`.", 2),
        (doc_names.spans, "Look at `univoxel train --preset fast`.", 0),
        (doc_names.imports, "```python\nfrom univoxel import nothing\n```\n", 1),
        (doc_names.imports, "```python\nx = = 1\n```\n", 1),
        (doc_names.imports, "```python\nfrom univoxel import train\n```\n", 0),
        (partial(doc_names.targets, ROOT), "    make nothing\n\nRun `python tests/none.py`.", 2),
        (partial(doc_names.targets, ROOT), "    make test\n", 0),
        *(
            (partial(doc_names.unknown, ROOT), f"A page with `{code}`.", 1)
            for code in ("StageConfig.none", "NoneConfig.rays", "NO_SUCH_ONE", "joint/none.py")
        ),
        (partial(doc_names.unknown, ROOT), "`StageConfig.rays`, `output/timelapse.py`, `DATA`", 0),
        (doc_truth.unknown_flags, "Use `--presett fast`, or `--preset fast`.", 1),
        (doc_truth.unknown_flags, "`cutout --source none`, as `--from` says", 1),
        (doc_truth.unknown_flags, "    univoxel lab chart X --out Y \\\n        --onli draft\n", 1),
        (doc_truth.unknown_flags, "    univoxel train X --out Y --preset fast  # not --fast\n", 0),
        (doc_truth.unknown_flags, "`pip install --no-deps univoxel`, `git clone --depth 1`", 0),
        (doc_prose.long_lines, f"short\n{LONG}\n", 1),
        (doc_prose.long_lines, f"| {LONG} |\n```\n{LONG}\n```\n[text]({'x' * 99})\n", 0),
        (leaves_docs, "../../CONTRIBUTING.md", 1),
        (leaves_docs, "../glossary.md", 0),
        (leaves_docs, "../../LICENSE", 0),
    ],
)
def test_names_that_are_not_there_and_what_pages_may_not_have_are_found(check, page, count):
    assert len(check(page)) == count


def test_a_tree_that_is_not_the_folders_is_found(tmp_path):
    (tmp_path / "univoxel" / "joint").mkdir(parents=True)
    page = tmp_path / "CONTRIBUTING.md"
    page.write_text("## The tree\n\n| `univoxel/none/` | nothing |\n\n## Rules\n")
    gone, lacks = doc_names.tree(tmp_path)
    assert "no such file or folder: univoxel/none/" in gone
    assert "the tree lacks joint/" in lacks


def test_a_promise_that_a_page_does_not_keep_is_found(tmp_path):
    (tmp_path / "docs/results").mkdir(parents=True)
    (tmp_path / "examples").mkdir()
    definitions, page = tmp_path / doc_truth.DEFINITIONS, tmp_path / "docs/page.md"
    figures = "<!-- begin x.json -->\n" + "| 1 |\n" * 300 + "<!-- end x.json -->\n"
    definitions.write_text(figures)
    page.write_text("[Metrics](results/index.md#metrics)\n" + figures + "a line\n" * 150)
    assert doc_truth.faults(tmp_path) == []
    page.write_text(figures + "a line\n" * 250)
    (tmp_path / "examples/run.py").write_text('"""univoxel export RUN --texturesize 2"""\n')
    (long,) = doc_prose.faults(tmp_path)
    assert re.fullmatch(r"docs/page\.md: 25\d lines, at most 200", long)
    undefined, flag = doc_truth.faults(tmp_path)
    assert undefined == "docs/page.md: has a table of figures and no link to docs/results/index.md"
    assert flag == "examples/run.py: no such option: --texturesize"
    (tmp_path / "examples/run.py").rename(tmp_path / "examples/run.ipynb")
    (tmp_path / "examples/run.ipynb").write_text('{"cells": [{"source": ["`train --fast`"]}]}')
    assert doc_truth.faults(tmp_path)[-1] == "examples/run.ipynb: no such option: --fast"


def test_every_public_name_has_a_section():
    text = doc_python.python()
    public = [name for name in univoxel.__all__ if f"### univoxel.{name}\n" not in text]
    assert public == ["Cancelled", "Run", "TrainingProgress", "UserError"]  # have other sections
    for name in ("Run.relight", "univoxel.run.Verdict", "Options of univoxel.train"):
        assert f"### {name}\n" in text
    assert "| `Cancelled` | `Exception` |" in text
    assert 'background: Literal["black", "white"] = "black",' in text
