"""Damaged files for every reader: one of two ends is allowed, a line that names the file, or use.

    python tests/fuzz.py [--cases N] [--readers NAME ..] [--case NAME:SEED] [--seed FIRST]

A case is a reader and a seed: the seed says what is damaged, and how. Cases run in a process of
their own, with a limit on memory and time, which is started anew where it dies. The table at the
end counts outcomes; any that is not `refused` or `accepted` makes the exit code 1, and the line
with the case says how to see it again.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import logging
import os
import resource
import select
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from analytic import cameras_around, sphere_scene
from layouts import scene, write_colmap, write_llff, write_nerf, write_nerfstudio, write_tensoir
from PIL import Image

from lab.record import load_outcome
from univoxel.config import check_same, save_config
from univoxel.core.records import Mesh
from univoxel.data import Photos, keep_photos, load_cameras, load_photos, load_points, load_truth
from univoxel.data.images import image_size, read_image, write_exr
from univoxel.data.truth import read_ply
from univoxel.envmap import read_map
from univoxel.errors import NoSurface, UserError
from univoxel.output.mesh_files import write_ply
from univoxel.presets import preset
from univoxel.render.pipeline import shade_hits, surface_of_view
from univoxel.run import photos_of, trained_on
from univoxel.scene import load_checkpoint, save_scene

MEMORY = 3 << 30  # bytes beyond what the worker has when it begins
SECONDS = 60.0  # of a case, at most; most take milliseconds, but the machine may be shared
GOOD = ("refused", "accepted")
OUTCOMES = (*GOOD, "nonsense", "nameless", "noise", "traceback", "memory", "hang", "signal")


@dataclass(frozen=True)
class Reader:
    """Something that reads files: a row of the table below."""

    write: Callable[[Path], object]  # a sound data set into a folder
    damaged: str  # the files that are damaged, as a pattern in the folder
    read: Callable[[Path], object]  # the folder; raises Nonsense if what it accepts is of no use


class Nonsense(Exception):
    """What was accepted holds NaN, infinity or a camera that sees nothing."""


def sound(*tensors: torch.Tensor | np.ndarray | None) -> None:
    for tensor in tensors:
        if tensor is not None and not np.isfinite(np.asarray(tensor)).all():
            raise Nonsense("NaN or infinity")


def sound_photos(photos: Photos) -> None:
    cameras = photos.cameras
    sound(photos.color, photos.alpha, cameras.camera_to_world, cameras.focal, cameras.centre)
    if not (cameras.focal > 0).all():
        raise Nonsense("a focal length of 0")


def photos(folder: Path) -> None:
    sound_photos(load_photos(folder))


def camera_path(folder: Path) -> None:
    _, cameras = load_cameras(folder / "transforms_train.json", 64)
    sound(cameras.camera_to_world, cameras.focal, cameras.centre)
    if max(cameras.width, cameras.height) > 1 << 16 or not (cameras.focal > 0).all():
        raise Nonsense("no camera")


def picture(name: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        if not name.endswith(".hdr"):
            image_size(folder / name)
        sound(read_image(folder / name))

    return read


def gradient(channels: int = 3) -> np.ndarray:
    row, column = np.mgrid[:16, :32]
    return np.stack([(row * (k + 3) + column * 5) % 251 for k in range(channels)], -1)


def write_pillow(name: str, channels: int, **options) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        Image.fromarray(gradient(channels).astype(np.uint8)).save(folder / name, **options)

    return write


def write_map(folder: Path) -> None:
    colors = np.moveaxis(gradient() / 50, -1, 0)
    write_exr(folder / "map.exr", dict(zip("RGB", colors, strict=True)))


def environment_map(folder: Path) -> None:
    sound(read_map(folder / "map.exr").radiance)


def write_hdr(folder: Path, packed: bool = True) -> None:
    """Rows of run lengths, or flat ones."""
    pixels = np.concatenate([gradient() % 128, np.full((16, 32, 1), 129)], -1).astype(np.uint8)
    body = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 16 +X 32\n"
    for row in pixels:
        if packed:
            body += bytes([2, 2, 0, 32]) + b"".join(bytes([32, *c]) for c in row.T.tolist())
        else:
            body += row.tobytes()
    (folder / "map.hdr").write_bytes(body)


def write_mesh(folder: Path) -> None:
    vertices = torch.rand(9, 3, generator=torch.Generator().manual_seed(0))
    write_ply(folder / "mesh.ply", Mesh(vertices, torch.arange(9, dtype=torch.int32).view(3, 3)))


def mesh(folder: Path) -> None:
    found = read_ply(folder / "mesh.ply")
    sound(found.vertices)
    if len(found.faces) and not 0 <= found.faces.min() <= found.faces.max() < len(found.vertices):
        raise Nonsense("a face without vertices")


def write_truth(folder: Path) -> None:
    write_nerf(folder, scene())
    shape = (8, 12)
    arrays: dict[str, Any] = {
        "albedo": np.full((*shape, 3), 0.5),
        "normal": np.full((*shape, 3), 0.577),
    }
    arrays |= {"roughness": np.full(shape, 0.5), "depth": np.full(shape, 3.0)}
    (folder / "test" / "gt").mkdir()
    for name in ("p_000", "p_008"):
        path = folder / "test" / "gt" / f"{name}.npz"
        np.savez(path, **arrays, alpha=np.full(shape, 255, np.uint8))
    np.savez(folder / "points.npz", points=np.random.default_rng(0).random((20, 3)))


def truth(folder: Path) -> None:
    sound(load_points(folder))
    found = load_truth(load_photos(folder, "test"), 0)
    sound(found.albedo, found.roughness, found.normal, found.depth)


STATE = {
    **{"stage": 1, "progress": 0.5, "step": 7, "made": [1.0], "early": [0], "seconds": 3.0},
    **{"took": [2.0], "stage_took": 1.0, "finished": True},
    "chosen": [{"what": "rows", "before": 9, "after": 4, "cost": 0.1, "why": "few", "said": "so"}],
    "troubles": ["a step"],
}


def write_checkpoint(slim: bool) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        save_scene(sphere_scene(32, voxel_size=0.12), folder, STATE, slim, 3.0 if slim else None)

    return write


def checkpoint(folder: Path) -> None:
    """Loaded, and drawn: what is accepted must be of use."""
    found, state = load_checkpoint(folder)
    if not isinstance(state, dict):
        raise Nonsense("no state")
    try:
        surface, wo = surface_of_view(found, cameras_around(1, 8), 0)
        sound(surface.albedo, surface.roughness, surface.normal, surface.opacity)
        sound(shade_hits(found, surface, wo, 0))
    except NoSurface:
        pass


def write_run(folder: Path) -> None:
    """A run's configuration, on data beside it whose photographs are kept."""
    data = write_nerf(folder / "data", scene())
    config = preset("draft", data, folder / "run")
    config.out.mkdir()
    save_config(config)
    (folder / "moved").write_text(str(folder))


def config_of_run(folder: Path) -> None:
    run = folder / "run"
    path = run / "config.json"
    before = (folder / "moved").read_text()  # the folder that it was written in
    path.write_bytes(path.read_bytes().replace(before.encode(), str(folder).encode()))
    with contextlib.suppress(UserError):  # both are asked, whatever the other says
        check_same(preset("draft", folder / "data", run))
    trained_on(run)
    sound_photos(photos_of(run))


def write_kept(folder: Path) -> None:
    keep_photos(load_photos(write_nerf(folder, scene()), downscale=2), folder / "kept.safetensors")


def kept(folder: Path) -> None:
    """Whatever happened to what is kept: the photographs are those of the files."""
    found = load_photos(folder, downscale=2, kept=folder / "kept.safetensors")
    if not torch.equal(found.color, load_photos(folder, downscale=2).color):
        raise Nonsense("other photographs")


def write_result(folder: Path) -> None:
    result = {"scene": "a", "setting": "b", "identity": {}, "measures": {"nvs_psnr": 30.0}}
    (folder / "result.json").write_text(json.dumps(result | {"log": [{"seconds": 1.0}]}))


READERS: dict[str, Reader] = {
    "transforms": Reader(lambda f: write_nerf(f, scene()), "transforms_train.json", photos),
    "camera path": Reader(lambda f: write_nerf(f, scene()), "transforms_train.json", camera_path),
    "nerfstudio": Reader(lambda f: write_nerfstudio(f, scene()), "transforms.json", photos),
    "colmap binary": Reader(lambda f: write_colmap(f, scene()), "sparse/0/*.bin", photos),
    "colmap text": Reader(lambda f: write_colmap(f, scene(), text=True), "sparse/0/*.txt", photos),
    "llff": Reader(lambda f: write_llff(f, scene()), "poses_bounds.npy", photos),
    "tensoir": Reader(lambda f: write_tensoir(f, scene()), "train_*/metadata.json", photos),
    "photographs": Reader(lambda f: write_nerfstudio(f, scene()), "*/*.png", photos),
    "png": Reader(write_pillow("a.png", 4), "a.png", picture("a.png")),
    "jpeg": Reader(write_pillow("a.jpg", 3), "a.jpg", picture("a.jpg")),
    "exr": Reader(write_map, "map.exr", picture("map.exr")),
    "hdr": Reader(write_hdr, "map.hdr", picture("map.hdr")),
    "hdr flat": Reader(lambda f: write_hdr(f, False), "map.hdr", picture("map.hdr")),
    "environment map": Reader(write_map, "map.exr", environment_map),
    "ply": Reader(write_mesh, "mesh.ply", mesh),
    "npz": Reader(write_truth, "**/*.npz", truth),
    "checkpoint": Reader(write_checkpoint(False), "scene.safetensors", checkpoint),
    "slim checkpoint": Reader(write_checkpoint(True), "scene.safetensors", checkpoint),
    "config.json": Reader(write_run, "run/config.json", config_of_run),
    "kept photographs": Reader(write_kept, "kept.safetensors", kept),
    "result.json": Reader(write_result, "result.json", load_outcome),
}


def nonsense(_: Path) -> None:
    sound(np.array([np.nan]))


def nameless(_: Path) -> None:
    raise UserError("expected something else")


# Readers that fail, by the outcome that they should have: the fuzzer must see it
FAILING: dict[str, Reader] = {
    name: Reader(write_hdr, "map.hdr", read)
    for name, read in {
        "nonsense": nonsense,
        "nameless": nameless,
        "noise": lambda _: os.write(2, b"a line of a library"),
        "traceback": lambda _: {}["a"],
        "memory": lambda _: bytearray(2 * MEMORY),
        "hang": lambda _: time.sleep(1000),
        "signal": lambda _: os.kill(os.getpid(), signal.SIGSEGV),
    }.items()
}


# Damage. Each function takes the bytes of a file and gives other ones

COUNTS = (0, 1, 10**9, 2**31 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1)
NUMBERS = (float("nan"), float("inf"), -float("inf"), 1e308, -1e308, 1e-320, 0.0, -1.0)
VALUES = (
    *(None, True, False, "", "sub/a", "../../etc/passwd", "/dev/zero", "\0", "\udcff", "x" * 10**5),
    *(0, -1, 1, 7, 10**5, 10**9, 2**31, 2**63, 10**400, [], {}, [[]], [1.0] * 1000),
    *NUMBERS,
)
WORDS = tuple(f"nan inf -1 0 1e308 1e-320 1e9 x # {'9' * 400} {'9' * 5000} ../../a \0 ".split(" "))


def flipped(data: bytes, rng: np.random.Generator) -> bytes:
    found = bytearray(data)
    for at in rng.integers(0, len(found), int(2 ** rng.uniform(0, 6))):
        found[at] ^= 1 << rng.integers(8)
    return bytes(found)


def cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: rng.integers(0, len(data))]


def moved(data: bytes, rng: np.random.Generator) -> bytes:
    """A piece is lost, doubled, zeroed or set."""
    a, b = sorted(rng.integers(0, len(data) + 1, 2).tolist())
    piece = data[a:b]
    return data[:a] + (b"", piece * 2, bytes(b - a), b"\xff" * (b - a))[rng.integers(4)] + data[b:]


def counted(data: bytes, rng: np.random.Generator) -> bytes:
    """A count of 10^9 and the like, or a number that is none, where some number may stand."""
    form = ("<I", "<Q", ">I", "<H", ">H", "<f", "<d")[rng.integers(7)]
    value = NUMBERS[rng.integers(5 if form == "<d" else 3)]
    if form[1] in "IQH":
        value = COUNTS[rng.integers(len(COUNTS))] % (1 << 8 * struct.calcsize(form))
    # Headers are where counts stand: half of the damage is in the first bytes
    room = max(1, len(data) - struct.calcsize(form))
    at = int(rng.integers(0, min(room, 200) if rng.integers(2) else room))
    return data[:at] + struct.pack(form, value) + data[at + struct.calcsize(form) :]


def hostile_json(data: bytes, rng: np.random.Generator) -> bytes:
    """A value of another type or size, a key that is lost or new; as text: doubled keys, depth."""
    root = json.loads(data)
    for _ in range(rng.integers(1, 4)):
        _change(root, rng)
    match rng.integers(12):
        case 0:
            return b"\xef\xbb\xbf" + json.dumps(root).encode()
        case 1:
            return b'{"frames": [], ' + json.dumps(root).encode()[1:]
        case 2:
            deep = 10 ** int(rng.integers(3, 6))
            return b'{"more": ' + b"[" * deep + b"]" * deep + b"," + data.lstrip()[1:]
        case 3:
            return b'{"more": ' + b"1" * 5000 + b"," + data.lstrip()[1:]
    return json.dumps(root).encode()


def _change(node: Any, rng: np.random.Generator) -> None:
    """Change a list or an object somewhere within."""
    while True:
        keys = list(node) if isinstance(node, dict) else list(range(len(node)))
        if not keys:
            return
        key = keys[rng.integers(len(keys))]
        if isinstance(node[key], dict | list) and rng.integers(4):
            node = node[key]
            continue
        match rng.integers(8):
            case 0:
                del node[key]
            case 1 if isinstance(node, dict):
                node[f"{key}_"] = node[key]
            case 2 if isinstance(node, list):
                node += [node[key]] * int(rng.integers(1, 2000))
            case _:
                node[key] = VALUES[rng.integers(len(VALUES))]
        return


def hostile_text(data: bytes, rng: np.random.Generator) -> bytes:
    lines = data.decode().split("\n")
    for _ in range(rng.integers(1, 4)):
        words = lines[line := int(rng.integers(len(lines)))].split(" ")
        words[rng.integers(len(words))] = WORDS[rng.integers(len(WORDS))]
        lines[line] = " ".join(words)
    if not rng.integers(4):
        lines += lines * 3
    return "\n".join(lines).encode()


def hostile_png(data: bytes, rng: np.random.Generator) -> bytes:
    """A header that promises a huge picture, its checksum right."""
    width, height = (int(x) for x in rng.choice([1, 32, 20000, 65535, 10**9, 2**31 - 1], 2))
    depth, kind = (int(x) for x in (rng.choice([1, 8, 16]), rng.choice([0, 2, 3, 4, 6])))
    head = b"IHDR" + struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)
    return data[:12] + head + struct.pack(">I", zlib.crc32(head)) + data[33:]


def hostile_hdr(data: bytes, rng: np.random.Generator) -> bytes:
    head, _, body = data.partition(b"-Y 16 +X 32")
    height, width = rng.choice([0, 1, 8, 16, 32, 32767, 65536, 10**9, 10**15], 2).tolist()
    return head + f"-Y {height} +X {width}".encode() + body


def hostile_ply(data: bytes, rng: np.random.Generator) -> bytes:
    head, mark, body = data.partition(b"end_header\n")
    return hostile_text(head, rng) + mark + body


def hostile_array(rng: np.random.Generator, array: np.ndarray) -> np.ndarray:
    match rng.integers(8):
        case 0:
            return array[..., :-1] if array.ndim else array
        case 1:
            return array.astype(str)
        case 2:
            return array.astype(object)
        case 3:
            return array.astype([np.complex64, np.float16, np.int8, bool][rng.integers(4)])
        case 4:
            return array[None]
        case 5:
            return array[:0] if array.ndim else array
    found = array.astype(np.float64)
    found.flat[rng.integers(0, max(found.size, 1), 3)] = NUMBERS[rng.integers(len(NUMBERS))]
    return found


def hostile_npy(data: bytes, rng: np.random.Generator) -> bytes:
    encoded = io.BytesIO()
    np.save(encoded, hostile_array(rng, np.load(io.BytesIO(data))), allow_pickle=True)
    return encoded.getvalue()


def hostile_npz(data: bytes, rng: np.random.Generator) -> bytes:
    """Arrays of other shapes and types; or damage inside, under right checksums."""
    encoded = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(encoded, "w") as new:
        names = old.namelist()
        chosen = names[rng.integers(len(names))]
        for name in names:
            inner = old.read(name)
            if name == chosen:
                change = (hostile_npy, counted, flipped, cut, lambda *_: b"")[rng.integers(5)]
                inner = change(inner, rng)
            new.writestr(name if name != chosen or rng.integers(8) else "other.npy", inner)
            if name == chosen and not rng.integers(8):
                with contextlib.suppress(UserWarning):  # of the same name
                    new.writestr(name, inner)
    return encoded.getvalue()


def hostile_safetensors(data: bytes, rng: np.random.Generator) -> bytes:
    """Another description, other tensors, or numbers that are none."""
    (size,) = struct.unpack_from("<Q", data)
    head, body = json.loads(data[8 : 8 + size]), data[8 + size :]
    meta = head.get("__metadata__", {})
    what = rng.integers(4)
    if what < 2 and "univoxel" in meta:
        inner = json.loads(meta["univoxel"])
        for _ in range(rng.integers(1, 3)):
            _change(inner, rng)
        meta["univoxel"] = json.dumps(inner)
    elif what == 2:
        _change(head, rng)
    else:
        at = 4 * int(rng.integers(0, max(len(body) // 4, 1)))
        number = struct.pack("<f", NUMBERS[rng.integers(3)])
        body = body[:at] + (number * 8)[: len(body) - at] + body[at + 32 :]
    text = json.dumps(head).encode()
    return struct.pack("<Q", len(text)) + text + body


HOSTILE = {
    ".json": hostile_json,
    ".txt": hostile_text,
    ".png": hostile_png,
    ".hdr": hostile_hdr,
    ".ply": hostile_ply,
    ".npy": hostile_npy,
    ".npz": hostile_npz,
    ".safetensors": hostile_safetensors,
}


def damage(folder: Path, reader: Reader, rng: np.random.Generator) -> str:
    """Damage one of a reader's files; what was done, in words."""
    files = sorted(folder.glob(reader.damaged))
    path = files[rng.integers(len(files))]
    kinds = [flipped, cut, moved, counted]
    kinds += [HOSTILE[path.suffix]] * 4 if path.suffix in HOSTILE else []
    change = kinds[rng.integers(len(kinds))]
    path.write_bytes(change(path.read_bytes(), rng))
    return f"{path.name} {change.__name__}"


# One case, in the worker


def outcome_of(name: str, seed: int, sound_ones: Path, said: Path) -> tuple[str, str]:
    """The outcome of a case, and what there is to say of it.

    Args:
        sound_ones: folder of what readers' `write` made, by reader.
        said: the file that stderr goes to.
    """
    reader = (READERS | FAILING)[name]
    rng = np.random.default_rng([zlib.crc32(name.encode()), seed])
    kept_in = sound_ones / name
    if not kept_in.exists():
        kept_in.mkdir()
        reader.write(kept_in)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(shutil.copytree(kept_in, Path(place) / "case"))
        done = damage(folder, reader, rng)
        before = said.stat().st_size
        try:
            reader.read(folder)
            outcome, why = "accepted", ""
        except Nonsense as error:
            outcome, why = "nonsense", str(error)
        except UserError as error:
            outcome, why = "refused", str(error)
            if "/" not in why:  # a path: of the file, or of what it names
                outcome = "nameless"
        except MemoryError as error:
            outcome, why = "memory", repr(error)
        except Exception as error:  # all that is left is a finding
            outcome = "memory" if "can't allocate memory" in str(error) else "traceback"
            if isinstance(error, OSError) and error.filename:
                outcome = "refused"
            why = "".join(traceback.format_exception(error)[-3:])
        sys.stdout.flush()
        sys.stderr.flush()
        if outcome in GOOD and said.stat().st_size > before:
            outcome, why = "noise", said.read_text(errors="replace")[before:]
    return outcome, f"{done}: {why}"


def work() -> None:
    """Answer cases on stdin, a line each, on stdout."""
    torch.set_num_threads(1)
    logging.getLogger("univoxel").addHandler(logging.NullHandler())  # strangers' lines are noise
    with tempfile.TemporaryDirectory() as place:
        said = Path(place) / "said"
        answers = os.fdopen(os.dup(1), "w", buffering=1)
        nowhere = os.open(said, os.O_CREAT | os.O_WRONLY | os.O_APPEND)
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        for name in READERS:  # what they import and start counts for nothing
            outcome_of(name, 0, Path(place), said)
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        print(json.dumps(["ready", ""]), file=answers)
        for line in sys.stdin:
            name, seed = json.loads(line)
            print(json.dumps(outcome_of(name, seed, Path(place), said)), file=answers)


class Worker:
    """A process for many cases, started anew where one ends it."""

    def __init__(self, seconds: float = SECONDS) -> None:
        """
        Args:
            seconds: that a case may take.
        """
        self._seconds = seconds
        self._process: subprocess.Popen[str] | None = None

    def ask(self, name: str, seed: int) -> tuple[str, str]:
        """The outcome of a case, and what there is to say of it."""
        if self._process is None:
            command = [sys.executable, __file__, "--work"]
            environment = os.environ | {"OMP_NUM_THREADS": "1"}
            pipe = subprocess.PIPE
            self._process = subprocess.Popen(
                command, stdin=pipe, stdout=pipe, text=True, env=environment
            )
            if self._answer(600) is None:
                raise RuntimeError("the worker of the fuzzer does not start")
        assert self._process
        assert self._process.stdin
        self._process.stdin.write(json.dumps([name, seed]) + "\n")
        self._process.stdin.flush()
        answer = self._answer(self._seconds)
        if answer is not None:
            return answer
        hanging, code = self._process.poll() is None, self.close()
        return ("hang", f"more than {self._seconds:g} s") if hanging else ("signal", f"code {code}")

    def _answer(self, seconds: float) -> tuple[str, str] | None:
        assert self._process
        assert self._process.stdout
        ready, _, _ = select.select([self._process.stdout], [], [], seconds)
        line = self._process.stdout.readline() if ready else ""
        if not line:
            if ready:
                self._process.wait()
            return None
        return tuple(json.loads(line))

    def close(self) -> int | None:
        """End the process, if there is one; its exit code."""
        process, self._process = self._process, None
        if process is None:
            return None
        process.kill()
        process.communicate()
        return process.returncode


def run(
    names: list[str], cases: int, first: int = 1, quiet: bool = True
) -> dict[str, Counter[str]]:
    """Run so many cases of each reader; print what is bad at once, and a table of outcomes."""
    worker, counts = Worker(), {name: Counter() for name in names}
    begin = time.monotonic()
    for name in names:
        for seed in range(first, first + cases):
            outcome, why = worker.ask(name, seed)
            counts[name][outcome] += 1
            if outcome not in GOOD or not quiet:
                print(f"{outcome}: --case '{name}:{seed}': {why.strip()[:1500]}\n", flush=True)
    worker.close()
    print(" " * 17 + "".join(f"{outcome:>11}" for outcome in OUTCOMES))
    for name, count in (*counts.items(), ("all", sum(counts.values(), Counter()))):
        print(f"{name:>17}" + "".join(f"{count[outcome] or '.':>11}" for outcome in OUTCOMES))
    print(f"{cases * len(names)} cases in {time.monotonic() - begin:.0f} s")
    return counts


def main() -> int:
    """Parse, run; 1 where an outcome is bad."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--cases", type=int, default=200, help="of each reader")
    parser.add_argument("--seed", type=int, default=1, help="of the first case")
    parser.add_argument("--readers", nargs="*", default=list(READERS), choices=list(READERS))
    parser.add_argument("--case", help="NAME:SEED: this one alone, and all that it says")
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.work:
        work()
        return 0
    if chosen.case:
        name, _, seed = chosen.case.rpartition(":")
        counts = run([name], 1, int(seed), quiet=False)
    else:
        counts = run(chosen.readers, chosen.cases, chosen.seed)
    return int(any(count[bad] for count in counts.values() for bad in OUTCOMES[2:]))


if __name__ == "__main__":
    sys.exit(main())
