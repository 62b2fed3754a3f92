"""What no module does: unpickle, unpack, run what data say, start a shell, open a connection."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from analytic import write_scene
from tiny import OPTIONS

import univoxel
from univoxel.core.guard import guarded

PACKAGE = Path(univoxel.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))
# What is used of them all the same
NAMES_ONLY = {
    "batch/scenes.py": {"urllib"},  # names of files as addresses
    "data/path_sandbox.py": {"zipfile"},  # the errors of broken archives
    "viewer/training.py": {"socket", "urllib"},  # is a port free; of what host is a page
}
FORBIDDEN = {
    *("pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve"),
    *("tarfile", "zipfile", "yaml"),
    *("socket", "socketserver", "http", "urllib", "requests", "ftplib", "ssl", "asyncio"),
}
CALLS = {"eval", "exec", "compile", "__import__"}
STARTS = {f"subprocess.{name}" for name in ("run", "Popen", "call", "check_call", "check_output")}
METHODS = {
    *("os.system", "os.popen", "shutil.unpack_archive", "torch.load", "torch.hub.load"),
    *("subprocess.getoutput", "subprocess.getstatusoutput"),
}


def faults(source: str, allowed: frozenset[str] | set[str] = frozenset()) -> list[str]:
    """What a module does that none may, in words."""
    found = []
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Import(names=names):
                found += [a.name for a in names if a.name.partition(".")[0] in FORBIDDEN - allowed]
            case ast.ImportFrom(module=str(module)):
                found += [module] if module.partition(".")[0] in FORBIDDEN - allowed else []
            case ast.Call(func=ast.Name(id=name)) if name in CALLS:
                found.append(name)
            case ast.Call(func=ast.Attribute() as called, args=args, keywords=keywords):
                name, given = ast.unparse(called), {k.arg: k.value for k in keywords}
                found += [name] if name in METHODS else []
                if name == "np.load" and ast.unparse(given.get("allow_pickle", node)) != "False":
                    found.append("np.load without allow_pickle=False")
                if name in STARTS:
                    found += [f"{name} with a shell"] if "shell" in given else []
                    text = args and isinstance(args[0], ast.Constant | ast.JoinedStr)
                    found += [f"{name} of text"] if text else []
    return found


@pytest.mark.parametrize("path", MODULES, ids=lambda p: p.relative_to(PACKAGE).as_posix())
def test_no_module_trusts_data(path):
    allowed = NAMES_ONLY.get(path.relative_to(PACKAGE).as_posix(), set())
    text = path.read_text(encoding="utf-8")
    assert faults(text, allowed) == []
    assert set(re.findall(r"zipfile\.\w+", text)) <= {"zipfile.BadZipFile"}  # what NumPy raises


@pytest.mark.parametrize(
    "line",
    [
        "import pickle",
        "from urllib.request import urlopen",
        "import http.server",
        "eval(text)",
        "os.system(text)",
        "torch.load(path)",
        "np.load(path)",
        "np.load(path, allow_pickle=True)",
        "subprocess.run(command, shell=True)",
        "subprocess.run('ls')",
        "subprocess.Popen(f'ls {path}')",
    ],
)
def test_a_module_that_does_is_found(line):
    assert len(faults(line)) == 1


OFFLINE = """
import socket, sys
def refused(*_, **__):
    raise AssertionError("a connection was opened")
for name in ("connect", "connect_ex", "bind", "sendto"):
    setattr(socket.socket, name, refused)
socket.create_connection = socket.getaddrinfo = refused
"""
COMMANDS = f"""
from pathlib import Path
from univoxel.cli import main
here, run = Path(sys.argv[1]), str(Path(sys.argv[1]) / "run")
assert main(["train", str(here / "data"), "--out", run, *{OPTIONS}]) == 0
lit = ["--point", "0", "0", "3", "9", "--samples", "1", "--out", str(here / "lit")]
assert main(["info", run]) == 0
assert main(["export", run, "--mesh", str(here / "a.ply")]) == 0
assert main(["relight", run, *lit]) == 0
"""


def offline(script: str, *arguments: str) -> subprocess.CompletedProcess:
    """A script in a process whose sockets refuse; it has no other."""
    command = [sys.executable, "-c", OFFLINE + script, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_commands_open_no_connection(tmp_path):
    """Imports, a training of a few steps, and what is done with a run."""
    for script in (
        "socket.socket().bind(('127.0.0.1', 0))",
        "socket.create_connection(('::1', 9))",
    ):
        assert "a connection was opened" in offline(script).stderr
    write_scene(tmp_path / "data", views=6, size=16)
    done = offline(COMMANDS, str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.ply").is_file()
    assert len(list((tmp_path / "lit").glob("*.png"))) == 2


PROGRAM = "import sys, random, torch, univoxel.cli; print(sys.argv, univoxel.__file__)"


@pytest.mark.parametrize(
    ("arguments", "places"),
    [
        *((("-c", PROGRAM, "a"), places) for places in ("{path}", "{path}:", ".:{path}", ":")),
        (("-m", "univoxel.cli", "--version"), ".:{path}"),
        (("-m", "univoxel.capture.sfm"), ":"),
    ],
)
def test_processes_run_nothing_of_the_working_folder(arguments, places, tmp_path):
    """Modules of a stranger's data, and a clone that is not built: none of them is imported."""
    for name in ("random", "runpy", "torch", "importlib", "zlib", "univoxel", "usercustomize"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(f"raise SystemExit('ran {name}')")
        (tmp_path / f"{name}.py").write_text(f"raise SystemExit('ran {name}.py')")
    path = str(Path(univoxel.__file__).parent.parent)
    env = os.environ | {"PYTHONPATH": places.format(path=path)}
    with (tmp_path / "said").open("wb+") as said:
        with guarded(arguments, said, cwd=tmp_path, env=env) as process:
            code = process.wait()
        said.seek(0)
        text = said.read().decode()
    assert "ran " not in text
    match arguments[1]:
        case "univoxel.cli":
            assert (code, text.strip()) == (0, f"univoxel {univoxel.__version__}")
        case "univoxel.capture.sfm":
            assert "IndexError" in text.splitlines()[-1]  # of the argument that it was not given
        case _:
            assert (code, text.strip()) == (0, f"['-c', 'a'] {univoxel.__file__}")
