"""The command line over stand-ins for the work: what is passed on, what a mistake prints."""

import errno
import json
import logging
import os
import re
import subprocess
import sys
import types
from dataclasses import fields
from dataclasses import replace as replace_fields
from operator import attrgetter
from pathlib import Path

import pytest
import torch
from plain import plain_stage, plain_training

import univoxel
from univoxel import cli, errors
from univoxel.capture.config import DEFAULTS, FAST
from univoxel.cli import COMMANDS, LABORATORY, SPINS, laboratory, main, take_threads
from univoxel.cli.capture import CaptureOptions
from univoxel.cli.parsing import meanings
from univoxel.config import save_config
from univoxel.errors import ExistingFile, MissingExtra, MissingFile, ProcessFailed, UserError
from univoxel.presets import chosen

# What a command calls, by the module that holds it, if that is none of its own
WORK = {"train": "univoxel.cli.trainer", "poses": "univoxel.capture.poses"}
WORK |= {"cutout": "univoxel.capture.cutout"}
USUAL = {"network": "u2netp", "box": None, "keep_table": False}  # of how masks are made
KINDS = [k for k in vars(errors).values() if isinstance(k, type) and issubclass(k, UserError)]


@pytest.fixture
def calls(monkeypatch):
    """Replace the work; every call is noted as (name, args, kwargs)."""
    noted = []

    def task(name, result=None):
        def call(*args, **kwargs):
            noted.append((name, args, kwargs))
            if isinstance(result, BaseException):
                raise result
            return result

        return call

    def replace(name, result=None, **others):
        module = WORK.get(name, f"univoxel.cli.{name}")
        give(module, **{name: task(name, result)}, **others)

    def give(module, **functions):
        for name, function in functions.items():
            monkeypatch.setattr(f"{module}.{name}", function)

    def as_table(found):
        return f"table of {found}"

    replace("train", Path("run"))
    give("univoxel.cli.train", with_page=lambda run: run)
    replace("poses", Path("scene"))
    made = types.SimpleNamespace(
        page=Path("mug/index.html"), mesh=Path("mug/mug.glb"), run=Path("mug/run")
    )
    replace("capture", made)
    replace("cutout", Path("cut"))
    replace("evaluate", {"psnr": 31.25, "views": 5}, table=as_table)
    give("univoxel.cli.relight", relight_to_files=task("relight"))
    replace("envmap", None)
    found = {"chosen": [{"said": "lobes 24 -> 12"}]}
    replace("info", found, tables=lambda found: ["parts", "sizes"])
    return types.SimpleNamespace(noted=noted, replace=replace, give=give, task=task)


def test_train_passes_the_preset_and_the_changes_on(calls, tmp_path, capsys):
    out = tmp_path / "run"
    changes = ["loss.radiance=2", "seed=7", "stages.1.voxels=3", "stages.0.lr_sdf=(0.5, 0.1)"]
    text = "--preset draft --light sg --varying exposure --minutes 2 --downscale 4 --masks given"
    options = f"{text} --cameras refined --allow-outside".split()
    options += [f"--set={change}" for change in changes]
    assert main(["train", "photos", "--out", str(out), *options]) == 0
    expected = chosen("draft", 2.0, Path("photos"), out, "sg", "exposure")
    first, second, *others = expected.stages
    expected = replace_fields(
        expected,
        **{"masks": "given", "cameras": "refined", "downscale": 4, "allow_outside": True},
        seed=7,
        loss=replace_fields(expected.loss, radiance=2.0),
        stages=(
            replace_fields(first, lr_sdf=(0.5, 0.1)),
            replace_fields(second, voxels=3.0),
            *others,
        ),
    )
    assert capsys.readouterr().out == "run\n"
    assert calls.noted == [
        ("train", (expected,), {"resume": False, "timelapse": None, "view": None})
    ]


PHOTOS, RUN, OUT, CUP = map(Path, ("photos", "run", "out", "cup"))
LAB = {"compare": "lab.compare", "chart": "lab.chart", "stress": "lab.stress.suite"}
FILM = {"keep_size": 900, "keep_weak": True, "config": replace_fields(FAST, size=800, seed=3)}
OF_FILM = "--masks m --every 0.5 --keep-size 900 --keep-weak --fast --size 800 --seed 3"
MEASURED = {"run": RUN, "data": PHOTOS, "save": Path("dir"), "json": Path("m.json"), "samples": 8}
MEASURED |= {"bounces": 0, "test_every": 16, "background": "white", "fit_light": True}
TO_MEASURE = "--data photos --save dir --json m.json --samples 8 --bounces 0 --test-every 16"
LOOKED_AT = {"json": Path("a.json"), "picture": Path("b.png")}
TWO_MAPS = RUN, (Path("a.exr"), Path("b.exr")), Path("run/relight")
SUITE = OUT, ("sun", "dark"), ("sg", "sh"), 2, True, ("loss.radiance=2",)
COMPARED = (CUP, Path("shoe")), OUT, "draft", ("sg", "sg:lobes=12"), 2.0, ("seed=1",), 4
# Lines, and what they call it with, by place and by name
PASSED = [
    ("poses photos --out out", (PHOTOS, OUT, None, None), {"keep_size": 2000, "config": DEFAULTS}),
    (f"poses film.mp4 --out out {OF_FILM}", (Path("film.mp4"), OUT, Path("m"), 0.5), FILM),
    ("cutout photos --out out --downscale 2", (PHOTOS, OUT, "rembg", 2, False), USUAL),
    ("cutout photos --out out --from masks", (PHOTOS, OUT, "masks", 0, False), USUAL),
    ("info run --json a.json --picture b.png", (RUN,), LOOKED_AT),
    (f"eval run {TO_MEASURE} --background white --fit-light --full-size", (), MEASURED),
    ("relight run --envmap a.exr b.exr --orbit 3", TWO_MAPS, {"cameras": "orbit 3"}),
    (
        "relight run --envmap maps/hall.exr --rotate 90",
        *((RUN, Path("maps/hall.exr"), Path("run/relight/hall")), {"rotate": 90.0}),
    ),
    ("envmap run --out out --height 32 --light-of 2", (), {"height": 32, "light_of": "2"}),
    (
        "lab compare cup shoe --out out --preset draft --samples 4 --set seed=1 "
        "--light sg sg:lobes=12 --minutes 2",
        *(COMPARED, {}),
    ),
    (
        "chart cup --out out --samples 4 --set seed=1 --light sg --quick --only draft",
        *(((CUP,), OUT, "fast", "sg", True, ("draft",), ("seed=1",), 4, 1), {}),
    ),
    (
        "stress --out out --quick --only sun dark --light sg sh --seeds 2 --set loss.radiance=2",
        *(SUITE, {"jobs": 1, "scheduler": None}),
    ),
    ("lab stress --out out", (OUT, (), (), None, False, ()), {}),
]


@pytest.mark.parametrize(("line", "given", "named"), PASSED, ids=[row[0] for row in PASSED])
def test_options_reach_the_work(calls, capsys, line, given, named):
    for name, module in LAB.items():
        calls.give(module, **{name: calls.task(name, "done")})
    assert main(line.split()) == 0
    ((_, found, options),) = calls.noted
    assert found == given
    assert {key: options[key] for key in named} == named
    assert capsys.readouterr().out


def test_maps_are_compared_where_the_truth_is_known(calls, capsys):
    found = types.SimpleNamespace(ball_psnr=31.24, brightest_degrees=4.0, mirror_psnr=18.06)
    calls.replace("envmap", found)
    assert main(["envmap", "run", "--out", "map.exr"]) == 0
    _, ball, mirror, brightest = capsys.readouterr().out.splitlines()
    assert "31.2 dB" in ball
    assert "18.1 dB" in mirror
    assert "4.0 degrees" in brightest


def test_experiments_that_cannot_begin_or_are_interrupted(calls, capsys):
    assert main(["compare", "cup", "--out", "out", "--minutes", "-1"]) == 2
    assert "--minutes must be above 0, got -1" in capsys.readouterr().err
    calls.give("lab.chart", chart=calls.task("chart", KeyboardInterrupt()))
    assert main(["chart", "cup", "--out", "out"]) == 130
    assert "finished runs are in out" in capsys.readouterr().err


def test_capture_until_a_step(calls, capsys):
    find = calls.task("find", Path("mug/cut"))
    calls.give("univoxel.cli.capture", find_data=find)
    assert main(["capture", "photos", "--out", "mug", "--until", "masks"]) == 0
    assert capsys.readouterr().out == "mug/cut\n"
    assert calls.noted[0][2] == vars(CaptureOptions(Path("photos"), Path("mug"), until="masks"))
    assert main(["capture", "photos", "--out", "mug", "--until", "cameras", "--minutes", "2"]) == 2
    said = "--until cameras does not train: leave out --preset, --light, --minutes and --set"
    assert said in capsys.readouterr().err


def test_capture(calls, capsys):
    options = ["--masks", "rembg", "--preset", "draft", "--light", "sg", "--minutes", "2"]
    assert main(["capture", "photos", "--out", "mug", *options, "--set=seed=3"]) == 0
    assert capsys.readouterr().out == "mug/index.html\nmug/mug.glb\n"
    told: dict = {"masks": "rembg", "preset": "draft", "light": "sg", "minutes": 2.0}
    asked = CaptureOptions(Path("photos"), Path("mug"), **told, changes=("seed=3",))
    assert calls.noted == [("capture", (), vars(asked))]
    assert main(["capture", "photos", "--out", "mug", "--minutes", "0"]) == 2
    assert "--minutes must be above 0" in capsys.readouterr().err
    calls.replace("capture", KeyboardInterrupt())
    assert main(["capture", "photos", "--out", "mug"]) == 130
    assert "finished steps are in mug: run the same command again" in capsys.readouterr().err


def test_train_as_another_run_was_trained(calls, tmp_path, capsys):
    (tmp_path / "before").mkdir()
    stages = (plain_stage(voxels=1.0, iterations=10, share=1.0),)
    before = plain_training(Path("cup"), tmp_path / "before", stages, 1.0, downscale=2, seed=3)
    save_config(before)
    file = str(tmp_path / "before/config.json")
    options = ["--config", file, "--seed", "7", "--minutes", "2", "--set", "loss.radiance=2"]
    assert main(["train", "photos", "--out", str(tmp_path / "run"), *options]) == 0
    expected = replace_fields(
        before,
        data=Path("photos"),
        out=tmp_path / "run",
        downscale=0,  # these photographs are of another size
        seed=7,
        minutes=2.0,
        loss=replace_fields(before.loss, radiance=2.0),
    )
    assert calls.noted[-1][1] == (expected,)
    assert main(["train", "photos", "--out", str(tmp_path / "run"), "--config", file]) == 0
    assert calls.noted[-1][1][0].seed == 3
    both = ["--config", file, "--light", "sh"]
    assert main(["train", "photos", "--out", str(tmp_path / "run"), *both]) == 2
    assert "--light sh cannot be combined with --config" in capsys.readouterr().err
    assert main(["train", "photos", "--out", "x", "--config", str(tmp_path / "none.json")]) == 2
    assert "none.json: expected a configuration" in capsys.readouterr().err


def of_stage(number, name):
    return lambda config: getattr(config.stages[number], name)


@pytest.mark.parametrize(
    ("options", "of", "expected"),
    [
        ([], attrgetter("capacity", "budget_mb"), ("adaptive", None)),
        (["--capacity", "adaptive"], attrgetter("capacity", "budget_mb"), ("adaptive", None)),
        (["--capacity", "fixed"], attrgetter("capacity", "budget_mb"), ("fixed", None)),
        (["--budget-mb", "2.5"], attrgetter("capacity", "budget_mb"), ("adaptive", 2.5)),
        (["--metal", "all"], of_stage(2, "only_metal"), True),
        (["--field", "sparse"], attrgetter("capacity"), "fixed"),
        (["--field", "sparse", "--set=stages.1.voxels=30"], of_stage(1, "field"), "sparse"),
        (["--field", "sparse", "--set=stages.1.voxels=30"], of_stage(1, "voxels"), 30.0),
    ],
)
def test_what_options_make_of_the_configuration(calls, tmp_path, options, of, expected):
    assert main(["train", "photos", "--out", str(tmp_path / "run"), *options]) == 0
    assert of(calls.noted[0][1][0]) == expected


def test_train_does_not_overwrite_a_run(calls, tmp_path, capsys):
    (tmp_path / "scene.safetensors").touch()
    assert main(["train", "photos", "--out", str(tmp_path)]) == 2
    assert "already contains a run: add --resume" in capsys.readouterr().err
    assert main(["train", "photos", "--out", str(tmp_path), "--resume"]) == 0
    assert calls.noted[0][2] == {"resume": True, "timelapse": None, "view": None}
    film = ["--timelapse", "frames/"]
    assert main(["train", "photos", "--out", str(tmp_path), "--resume", *film]) == 0
    assert calls.noted[1][2] == {"resume": True, "timelapse": "frames/", "view": None}


@pytest.mark.parametrize(
    ("error", "message"),
    [
        *((kind("bad\n  input"), "bad input") for kind in KINDS),
        (UserError("eval: samples must be above 0", "samples"), "--samples must be above 0"),
        (UserError("light_of: none; see light_of", "light_of"), "--light-of: none; see light_of"),
        (UserError("changes=seed=x: bad", "changes"), "--set seed=x: bad"),
        (UserError("try out=b or box=a", "box", "out"), "try --out b or --box a"),
        (FileNotFoundError(2, "No such file", "a.png"), "[Errno 2] No such file: 'a.png'"),
        (OSError(errno.ENOSPC, "No space left"), "[Errno 28] No space left"),
        (MemoryError(), "MemoryError"),
        (RuntimeError("CPU: you tried to allocate 9 bytes: can't allocate memory"), "CPU: you"),
    ],
    ids=lambda x: type(x).__name__,
)
def test_a_mistake_is_one_line(calls, capsys, error, message):
    calls.replace("evaluate", error)
    assert main(["eval", "run"]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"univoxel eval: {message}")
    assert said.count("\n") == 1
    for option in ("--traceback", "--verbose"):
        with pytest.raises(type(error)):
            main(["eval", "run", option])


def test_a_mistake_is_what_it_was_in_the_library():
    """Handlers of the built-in kinds catch ours too."""
    assert {UserError} <= set(KINDS)
    for kind in KINDS:
        assert issubclass(kind, ValueError)
    assert issubclass(MissingExtra, ImportError)
    assert issubclass(MissingFile, FileNotFoundError)
    assert issubclass(ExistingFile, FileExistsError)
    assert issubclass(ProcessFailed, RuntimeError)


@pytest.mark.parametrize(
    "error",
    [
        ZeroDivisionError(),
        ValueError("from the depths"),
        RuntimeError("mat1 and mat2 shapes cannot be multiplied"),
        ImportError("cannot import name"),
        FloatingPointError(),
        OSError("no file of the user"),
        FileNotFoundError(2, "No such file", str(Path(univoxel.__file__).parent / "page.html")),
    ],
    ids=lambda x: type(x).__name__,
)
def test_a_bug_is_no_mistake_of_the_user(calls, error):
    calls.replace("evaluate", error)
    with pytest.raises(type(error)) as caught:
        main(["eval", "run"])
    assert caught.value is error
    assert any(entry.name == "call" for entry in caught.traceback)  # where it was raised


def test_the_package_speaks_through_its_logger(calls, capsys):
    logger = logging.getLogger("univoxel")
    before = logger.level, list(logger.handlers)

    def info(*_, **__):
        logging.getLogger("univoxel.somewhere").info(
            "%d pixels: see masks=auto", 3, extra={"arguments": ("masks",)}
        )
        logger.debug("nothing")
        return {"chosen": []}

    calls.give("univoxel.cli.info", info=info, tables=lambda found: [])
    assert main(["info", "run"]) == 0
    assert capsys.readouterr().out == "3 pixels: see --masks auto\n"
    assert before == (logger.level, logger.handlers)


@pytest.mark.parametrize("arguments", [["train", "--help"], ["--help"], ["--version"]])
def test_output_that_nobody_reads_to_its_end(arguments):
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "univoxel.cli", *arguments]
    run = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True)
    os.close(writer)
    assert run.stderr == ""
    assert run.returncode == 1


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("poses --keep-size -1", "--keep-size must be at least 0, got -1"),
        ("poses --every 0", "--every must be above 0, got 0"),
        ("poses --size 10", "CaptureConfig: size must be "),
        ("poses --features 0", "CaptureConfig: features must be "),
        ("cutout --downscale 0", "--downscale must be at least 1, got 0"),
        ("train --downscale -2", "--downscale must be at least 1, got -2"),
    ],
)
def test_numbers_out_of_range(calls, capsys, line, message):
    command, *options = line.split()
    assert main([command, "photos", "--out", "out", *options]) == 2
    assert capsys.readouterr().err.startswith(f"univoxel {command}: {message}")
    assert not calls.noted


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--minutes", "0"], "--minutes must be above 0, got 0"),
        (["--minutes", "nan"], "--minutes must be above 0, got nan"),
        (["--set", "seed"], "--set seed: expected FIELD=VALUE"),
        (["--set", "sede=1"], "--set sede=1: no field 'sede'; the fields are: data, out, stages"),
        (["--set", "seed.x=1"], "--set seed.x=1: no field 'x'; the fields are: none"),
        (["--set", "seed=fast"], "--set seed=fast: expected a value such as 0 (int), got 'fast'"),
        (
            ["--set", "stages.4.voxels=1"],
            "--set stages.4.voxels=1: no field '4'; the fields are: 0, 1",
        ),
    ],
)
def test_bad_options(calls, tmp_path, capsys, options, message):
    assert main(["train", "photos", "--out", str(tmp_path), *options]) == 2
    assert capsys.readouterr().err.startswith(f"univoxel train: {message}")
    assert calls.noted == []


@pytest.mark.parametrize(
    ("arguments", "message", "see"),
    [
        (["train"], "expected univoxel train DATA --out RUN; see ", "univoxel train"),
        (
            ["train", "x", "--out", "y", "--preset", "z"],
            "invalid choice 'z' for argument '--preset'. Expected one of ('auto', 'draft', ",
            "univoxel train",
        ),
        (["train", "x", "--out", "y", "--minutes", "a"], "Error parsing --minutes: ", "train"),
        (
            ["relight", "x", "--sampels", "3"],
            "Unrecognized options: --sampels, 3; perhaps you meant --samples; see ",
            "univoxel relight",
        ),
        (["sing"], "no command 'sing'; see ", "univoxel"),
        (["trian", "x"], "no command 'trian'; perhaps you meant train; see ", "univoxel"),
        (["lab", "comapre"], "no command 'comapre'; perhaps you meant compare", "univoxel lab"),
        (["compare"], "expected univoxel lab compare SCENE ", "univoxel lab compare"),
        (["doctor", "--threads", "0"], "--threads must be at least 1, got 0", "univoxel doctor"),
        (["doctor", "--quiet", "--verbose"], "expected --quiet or --verbose, got both", "doctor"),
    ],
)
def test_wrong_usage_is_one_line(calls, capsys, arguments, message, see):
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert err.startswith(f"univoxel: {message}")
    assert err.endswith(f"{see} --help\n")
    assert err.count("\n") == 1
    assert not out
    assert calls.noted == []


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"], ["help"]])
def test_help_is_one_screen_in_the_order_of_work(capsys, arguments):
    assert main(arguments) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) < 80
    named = [line.split()[0] for line in lines if line.startswith("  ")]
    assert set(named) == {*COMMANDS, "lab"}
    order = ["poses", "cutout", "train", "eval", "relight", "export", "demo", "doctor", "lab"]
    assert [name for name in named if name in order] == order
    assert all(line.strip() != line.split()[0] for line in lines[2:-1])  # each says what it does


@pytest.mark.parametrize("arguments", [["lab"], ["lab", "chart", "--help"], ["chart", "cup"]])
def test_without_a_clone_there_is_no_laboratory(calls, monkeypatch, tmp_path, capsys, arguments):
    assert main(["lab"]) == 0
    named = [line.split()[0] for line in capsys.readouterr().out.splitlines()[2:-1]]
    assert named == list(LABORATORY) == list(laboratory())
    assert not set(named) & set(COMMANDS)
    monkeypatch.setattr(cli, "CLONE", tmp_path)
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert err.startswith("univoxel: compare, chart, stress, bank, submit, published run ")
    assert err.count("\n") == 1
    assert not out
    assert main(["completion", "bash"]) == 0
    assert "stress" not in capsys.readouterr().out


def said(capsys, calls, *options):
    """What a command that logs at every level prints: stdout and stderr."""

    def info(*_, **__):
        logger = logging.getLogger("univoxel")
        for level in ("debug", "info", "warning"):
            getattr(logger, level)(level)
        logger.info("half", extra={"progress": True})
        return {"chosen": []}

    calls.give("univoxel.cli.info", info=info, tables=lambda found: ["the table"])
    assert main(["info", "run", *options]) == 0
    return [stream.split("\n")[:-1] for stream in capsys.readouterr()]


def test_quiet_leaves_results_and_warnings_and_verbose_says_when(capsys, calls):
    assert said(capsys, calls) == [["info", "warning", "the table"], ["half"]]
    assert said(capsys, calls, "--quiet") == [["warning", "the table"], []]
    out, err = said(capsys, calls, "--verbose")
    assert [line.split("s  ")[-1] for line in out] == ["debug", "info", "warning", "the table"]
    assert all(float(line.split()[0]) >= 0 for line in [*out[:-1], *err])


@pytest.fixture
def torch_threads():
    """How many threads torch has; it has them again after the test."""
    before = torch.get_num_threads()
    yield before
    torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("granted", "asked", "threads"),
    [(0.5, None, 1), (1.9, None, 1), (2.5, None, 2), (8.0, None, None), (1.0, "3", "3")],
)
def test_a_container_of_few_cores_gets_few_threads(
    granted, asked, threads, monkeypatch, torch_threads
):
    """Of a machine of eight cores, of which a control group grants so many."""
    monkeypatch.setattr("univoxel.core.system.usable_cores", lambda: 8)
    monkeypatch.setattr("univoxel.core.machine.cores", lambda: granted)
    monkeypatch.setenv("OMP_NUM_THREADS", asked or "")
    if asked is None:
        monkeypatch.delenv("OMP_NUM_THREADS")
    take_threads(None)
    assert os.environ.get("OMP_NUM_THREADS") == (None if threads is None else str(threads))
    assert torch.get_num_threads() == (threads if isinstance(threads, int) else torch_threads)


@pytest.mark.usefixtures("torch_threads")
@pytest.mark.parametrize(("asked", "cores", "threads"), [(1, 8, 1), (8, 8, 8), (10**9, 2, 2)])
def test_more_threads_than_cores_are_not_started(asked, cores, threads, monkeypatch):
    monkeypatch.setattr("univoxel.core.system.usable_cores", lambda: cores)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    take_threads(asked)
    assert os.environ["OMP_NUM_THREADS"] == str(threads)


@pytest.mark.usefixtures("torch_threads")
def test_threads_of_a_batch_may_be_of_larger_machines(calls, monkeypatch):
    """As examples/slurm_batch.py asks for, on a node that only submits."""
    monkeypatch.setattr("univoxel.core.system.usable_cores", lambda: 1)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    asked = {}
    calls.give("univoxel.cli.batch", batch=lambda _, threads: asked.update(threads=threads) or [])
    main(["batch", "scenes", "--out", "night", "--threads", "16"])
    assert asked == {"threads": 16}


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="a call of Linux")
def test_threads_of_a_process_that_may_use_one_core():
    """As taskset and `docker --cpuset-cpus` leave it."""
    code = (
        "import os, sys\nos.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "from univoxel.cli import main\nsys.exit(main(['doctor', '--json', '-']))"
    )
    env = {name: text for name, text in os.environ.items() if name != "OMP_NUM_THREADS"}
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env)
    found = {one["what"]: one["found"] for one in json.loads(run.stdout)}
    assert found["threads"] == "1 on 1 cores"


def test_threads_are_known_before_torch_is_imported():
    code = (
        "import sys\nfrom univoxel.cli import main\n"
        "sys.exit(main(['doctor', '--threads', '1', '--json', '-']))"
    )
    env = os.environ | {"OMP_NUM_THREADS": "2"}
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env)
    assert run.returncode == 0, run.stderr
    found = {one["what"]: one["found"] for one in json.loads(run.stdout)}
    assert found["threads"].startswith("1 on ")
    assert found["threads"].endswith("OMP_NUM_THREADS=1")


@pytest.mark.parametrize("command", ["info", "eval"])
def test_json_alone_on_stdout(capsys, calls, command):
    def write(*_, json, **__):
        logging.getLogger("univoxel").info("a remark")
        json.write_text('{"psnr": 30}\n')
        return {"chosen": []}

    task = {"info": "info", "eval": "evaluate"}[command]
    table = {"tables": lambda found: ["t"]} if task == "info" else {"table": lambda found: "t"}
    calls.give(f"univoxel.cli.{task}", **{task: write}, **table)
    assert main([command, "run", "--json", "-"]) == 0
    assert capsys.readouterr() == ('{"psnr": 30}\n', "a remark\n")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_names_commands_options_and_choices(capsys, shell):
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    for word in ("relight", "compare", "lab", "--orbit", "--budget-mb", "--quiet", "draft"):
        assert word.removeprefix("--") in script, word


def test_bash_completes(capsys, tmp_path):
    assert main(["completion", "bash"]) == 0
    (tmp_path / "script").write_text(capsys.readouterr().out)

    def completed(*words):
        code = (
            'source "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); '
            f'{entry} univoxel; printf "%s\\n" "${{COMPREPLY[@]}}"'
        )
        command = ["bash", "-c", code, "bash", str(tmp_path / "script"), "univoxel", *words]
        run = subprocess.run(command, capture_output=True, text=True, check=True)
        return {line.strip() for line in run.stdout.splitlines()}

    script = (tmp_path / "script").read_text()
    entry = re.search(r"^complete -o default -F (\S+) univoxel$", script, re.MULTILINE)[1]
    assert {"relight", "export"} <= completed("re") | completed("ex")
    assert "--preset" in completed("train", "--pre")
    assert {"draft", "fast", "full"} <= completed("train", "--preset", "")
    assert "compare" in completed("lab", "com")


def test_an_interrupt_says_what_was_kept(calls, tmp_path, capsys):
    calls.replace("train", KeyboardInterrupt())
    arguments = ["train", "photos", "--out", str(tmp_path), "--resume"]
    assert main(arguments) == 130
    assert capsys.readouterr().err.endswith(f"interrupted; nothing was saved in {tmp_path} yet\n")
    (tmp_path / "scene.safetensors").touch()
    assert main(arguments) == 130
    assert capsys.readouterr().err.endswith("continue with --resume\n")


@pytest.mark.parametrize(
    ("asked", "spins"),
    [({}, SPINS), ({"GOMP_SPINCOUNT": "7"}, "7"), ({"OMP_WAIT_POLICY": "passive"}, None)],
)
def test_waiting_threads_soon_sleep_unless_asked_otherwise(calls, monkeypatch, asked, spins):
    for name in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY"):
        monkeypatch.setenv(name, "")  # is put back after the test
        monkeypatch.delenv(name)
    for name, value in asked.items():
        monkeypatch.setenv(name, value)
    assert main(["info", "run"]) == 0
    assert os.environ.get("GOMP_SPINCOUNT") == spins


def test_help_does_not_wait_for_torch():
    code = (
        "import sys\nfrom univoxel.cli import main\n"
        "assert main(['train', '--help']) == 0\n"
        "assert 'torch' not in sys.modules"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert "--preset auto|draft|fast|full|best" in run.stdout


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("", "expected no empty arguments, got ''"),
        ("--out=", "expected no empty arguments, got '--out='"),
        ("run\udcff", r"expected arguments in UTF-8, got b'run\xff'"),
    ],
)
def test_arguments_that_no_command_can_use(calls, capsys, argument, message):
    """An empty path would be the present folder; a name that is not UTF-8 trained to its end."""
    rest = [argument] if argument.startswith("-") else ["--out", argument]
    assert main(["train", "photos", *rest]) == 2
    assert capsys.readouterr().err == f"univoxel: {message}; see univoxel --help\n"
    assert not calls.noted


@pytest.mark.parametrize("command", [*COMMANDS, *LABORATORY])
def test_help_is_short_and_fits(command, capsys):
    assert main([command, "--help"]) == 0
    said = capsys.readouterr().out
    assert not re.search(r"\(default: (?:|None|False|none)\)|\(repeatable\)", said)
    assert max(map(len, said.splitlines())) <= 100
    texts = meanings(COMMANDS[command].record) if hasattr(COMMANDS.get(command), "record") else {}
    assert [text for text in texts.values() if len(text) > 80] == []


@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "completion"])
def test_every_option_has_its_help_under_it(command):
    record = COMMANDS[command].record
    assert list(meanings(record)) == [field.name for field in fields(record)]
    assert all(meanings(record).values())
