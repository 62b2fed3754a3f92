"""Pages against results, code and rules: the checks of scripts/docs, and that they can fail."""

import inspect
import re
import shlex
import shutil
from pathlib import Path

import doc_blocks
import doc_prose
import doc_reference
import doc_tables
import pytest

from univoxel.cli import COMMANDS, LABORATORY, help_screen, laboratory, understood
from univoxel.cli.parsing import LAB, Usage

ROOT = Path(__file__).parent.parent
PAGES = sorted(doc_blocks.pages(ROOT))
COMMAND = re.compile(r"^    univoxel +(.+)$|^univoxel +([a-z]+ (?:\S*/|-).*)$", re.MULTILINE)


def test_pages_agree_with_results_and_code():
    assert doc_blocks.update(ROOT, write=False) == []


def test_every_result_is_shown():
    assert doc_blocks.unused(ROOT) == []


def test_pages_keep_the_rules_of_prose():
    assert doc_prose.faults(ROOT) == []


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


def test_a_changed_number_is_found(copy):
    assert doc_blocks.update(copy, write=False) == []
    page = copy / "README.md"
    text = page.read_text()
    page.write_text(re.sub(r"(\| sneaker \| \d+ \| )\d+\.\d", r"\g<1>99.9", text))
    (fault,) = doc_blocks.update(copy, write=False)
    assert re.match(r"README\.md:\d+: block chart\.json:small differs", fault)
    assert doc_blocks.update(copy, write=True) == []
    assert page.read_text() == text


def test_a_changed_result_is_found(copy):
    path = copy / "benchmarks/results/chart.json"
    changed = re.sub(
        r'"setting": "fast", "measures": \{"nvs_psnr": \d+', r"\g<0>1", path.read_text()
    )
    path.write_text(changed)
    (fault,) = doc_blocks.update(copy, write=False)
    assert "chart.json:small differs" in fault


def test_rows_of_different_commits_are_refused(copy):
    mixed = {
        "date": "2026-01-01",
        "commit": "b",
        "runs": {"x": {"commit": "a"}, "y": {"commit": "b"}},
    }
    with pytest.raises(ValueError, match="runs mix the commits a, b"):
        doc_tables.check_one_version(mixed)


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


def test_a_table_says_on_which_processor_it_was_measured():
    record = {"date": "2026-01-01", "commit": "a"}
    assert doc_tables.version(record) == "2026-01-01, commit a"
    processor = {"machine": {"processor": "P"}}
    assert doc_tables.version(record | processor) == "2026-01-01, commit a, P"


def test_tables_take_their_part_of_a_file():
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
    assert varying.endswith("| as they are | `none` | 1.0 |")


def test_a_block_that_does_not_end_is_found(copy):
    page = copy / "README.md"
    page.write_text(page.read_text().replace("<!-- end chart.json:small -->", ""))
    (fault,) = doc_blocks.update(copy, write=False)
    assert "begins or ends alone" in fault


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


def test_long_lines_are_found_but_for_tables_code_and_links():
    long = "word " * 21
    assert doc_prose.long_lines(f"short\n{long}\n") == [(2, 105)]
    for free in (f"| {long} |", f"```\n{long}\n```", f"[text]({'x' * 99})"):
        assert doc_prose.long_lines(f"{free}\n") == []


def test_a_link_to_markdown_outside_of_docs_is_found():
    page = ROOT / "docs/guide/page.md"
    assert doc_prose.leaves_docs(page, "../../CONTRIBUTING.md", ROOT)
    assert not doc_prose.leaves_docs(page, "../glossary.md", ROOT)
    assert not doc_prose.leaves_docs(page, "../../LICENSE", ROOT)


def commands() -> list[tuple[str, str]]:
    """Every command line of the pages: page and arguments."""
    found = []
    for page in PAGES:
        name = page.relative_to(ROOT).as_posix()
        text = re.sub(r" *\\\n *", " ", page.read_text(encoding="utf-8"))
        found += [(name, m[1] or m[2]) for m in COMMAND.finditer(text)]
    return [(name, line) for name, line in found if "[--" not in line and "COMMAND" not in line]


def check(line: str) -> None:
    """Refuse arguments that the command line would refuse.

    Raises:
        Usage: they make no command.
    """
    arguments = [a for a in shlex.split(line, comments=True) if a != "--traceback"]
    if sorted(arguments) in (["--version"], ["--verbose", "--version"]):
        return
    if help_screen(arguments) is None:
        understood(arguments)


@pytest.mark.parametrize(("page", "line"), commands())
def test_commands_of_the_pages_are_understood(page, line):
    check(line)


@pytest.mark.parametrize("line", ["trian x --out y", "train x --out y --presett fast", "eval"])
def test_a_command_that_is_not_understood_is_found(line):
    with pytest.raises(Usage):
        check(line)


def spans() -> list[tuple[str, str]]:
    """Every code span of the pages that names a command."""
    found = []
    for page in PAGES:
        text = " ".join(page.read_text(encoding="utf-8").split())
        for span in re.findall(r"`univoxel ([^`]+)`", text):
            if not span.startswith("was built"):  # a message
                found.append((page.relative_to(ROOT).as_posix(), span))
    return found


@pytest.mark.parametrize(("page", "span"), spans())
def test_commands_and_options_in_sentences_are_there(page, span):
    words = span.split()
    known = laboratory() if words[0] == LAB or words[0] in LABORATORY else COMMANDS
    name = words[1] if words[0] == LAB and len(words) > 1 else words[0]
    if name in (LAB, "COMMAND") or name.startswith("--"):
        return
    assert name in known, f"{page}: univoxel {span}"
    options = set(re.findall(r"--[a-z-]+", span)) - {"--help", "--quiet", "--verbose", "--threads"}
    parameters = inspect.signature(known[name]).parameters
    names = {"--" + p.replace("_", "-") for p in parameters} | {"--from"}
    assert options <= names, f"{page}: univoxel {span}"


@pytest.mark.parametrize("page", [p for p in PAGES if "```python" in p.read_text("utf-8")], ids=str)
def test_names_that_python_code_of_the_pages_imports_are_there(page):
    for block in re.findall(r"^```python\n(.*?)^```", page.read_text("utf-8"), re.M | re.S):
        if not re.match(r"\s*(?:@|def |class )", block):  # signatures of the reference
            compile(block, str(page), "exec")
        for line in re.findall(r"^(?:from|import) .*", block, re.MULTILINE):
            exec(line, {})


def test_folders_and_files_of_the_tree_are_there():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    tree = text.partition("## The tree")[2].partition("## Rules")[0]
    rows = re.findall(r"^\| (`.*?) \|", tree, re.MULTILINE)
    for name in re.findall(r"`([^`]+)`", " ".join(rows)):
        assert (ROOT / name).exists() or (ROOT / "univoxel" / name).exists(), name
    named = set(re.findall(r"`(?:univoxel/)?([a-z]+(?:\.py|/))`", tree))
    package = {p.name + "/" * p.is_dir() for p in (ROOT / "univoxel").iterdir()}
    unnamed = {n for n in package - named if not n.startswith(("_", "example_data", "py.typed"))}
    assert not unnamed, "add to the tree of CONTRIBUTING.md"


def targets(text: str) -> set[str]:
    return set(re.findall(r"^    make ([a-z-]+)", text, re.MULTILINE))


def test_targets_and_scripts_of_the_pages_are_there():
    there = re.search(r"\.PHONY: (.*)", (ROOT / "Makefile").read_text())
    assert there
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        assert targets(text) <= set(there.group(1).split()), page
        for script in re.findall(r"python ((?:benchmarks|scripts|examples|tests)/\S+)", text):
            assert (ROOT / script).exists(), f"{page}: {script}"
