"""The net under every move and rename: short trainings of the bundled scene with fixed steps.

Three trainings, each with other parts of the program, on one thread and without a limit of time.
Rounding depends on the processor, the extension, torch, its instruction set and its libraries, and
grows in training, so equal bits mean something on one machine and in one sitting alone: `make net
BASE=REV` makes them for a commit and for the working tree and compares. On any machine
tests/test_net.py asks how near the pictures come to those that the scene brings.

    python tests/net.py OUT.json              # hashes and pictures of what this tree makes
    python tests/net.py --compare ONE OTHER   # where two such files differ
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open

import univoxel
from univoxel.color import srgb_to_linear
from univoxel.config import TrainConfig
from univoxel.data.images import read_image
from univoxel.preparation import pose_refinement
from univoxel.presets import preset, with_field
from univoxel.training import metals

# What looks for a start by trials, with less to look at: each has tests of its own
FEWER = {(pose_refinement, "STEPS"): 60, (metals, "TRIAL_POINTS"): 150}
DATA = Path(univoxel.__file__).parent / "example_data" / "tiny"
COPY = 16  # pixels along a side of the small copies


def short(cfg: TrainConfig, **changes) -> TrainConfig:
    """A preset in few steps on coarse grids, with as much time as it wants."""
    stages = []
    for stage in cfg.stages:
        few = {"iterations": max(12, stage.iterations // 9), "rays": 256}
        if hasattr(stage, "voxels"):
            few["voxels"] = min(stage.voxels, 0.1)
        else:
            few |= {"points": 2000, "newton_points": 300, "rounds": 2}
        stages.append(dataclasses.replace(stage, **few))
    return dataclasses.replace(cfg, stages=tuple(stages), minutes=None, downscale=2, **changes)


def hybrid(out: Path) -> TrainConfig:
    """Everything that the presets do, with cameras refined and exposures."""
    cfg = short(preset("fast", DATA, out), cameras="refined", voxel_pixels=0.5)
    return dataclasses.replace(cfg, scene=dataclasses.replace(cfg.scene, varying="exposure"))


def varying(out: Path) -> TrainConfig:
    """Light that varies, on dense grids of fixed size."""
    cfg = with_field(preset("draft", DATA, out, varying="light"), "dense")
    return short(cfg, capacity="fixed")


def sparse(out: Path) -> TrainConfig:
    """Bricks, and lobes alone."""
    return short(with_field(preset("draft", DATA, out, "sg"), "sparse"))


CASES = {"hybrid": hybrid, "varying": varying, "sparse": sparse}


def digest(*arrays: np.ndarray) -> str:
    found = hashlib.sha256()
    for array in arrays:
        found.update(f"{array.dtype} {array.shape}".encode())
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


def small(picture: np.ndarray) -> str:
    """A copy [COPY, COPY, 3] in bytes, as hexadecimal digits, of means of a premultiplied linear
    picture [H, W, 4]."""
    rgb = np.clip(picture[..., :3], 0, 1) ** (1 / 2.2)
    rows, columns = (np.linspace(0, n, COPY + 1).astype(int) for n in rgb.shape[:2])
    means = [
        [rgb[a:b, c:d].mean((0, 1)) for c, d in itertools.pairwise(columns)]
        for a, b in itertools.pairwise(rows)
    ]
    return np.round(255 * np.array(means)).astype(np.uint8).tobytes().hex()


def distance_db(copy: str, other: str) -> float:
    """PSNR of a small copy against another, at most 90, after one factor: albedo and light share a
    scale that photographs do not fix."""
    a, b = (np.frombuffer(bytes.fromhex(x), np.uint8) / 255 for x in (copy, other))
    scale = (a * b).sum() / max((a * a).sum(), 1e-9)
    return float(-10 * np.log10(max(np.square(scale * a - b).mean(), 1e-9)))


def truth() -> dict[str, str]:
    """Small copies of what the pictures of `made` would be of a perfect training."""
    found = {}
    for of, file in (("render", "test/r_000.png"), ("relit", "relight/city/r_000.png")):
        straight = torch.as_tensor(read_image(DATA / file)) / 255
        linear = srgb_to_linear(straight[..., :3]) * straight[..., 3:]
        found[of] = small(linear.numpy())
    return found


def made(name: str, folder: Path) -> dict[str, dict[str, str]]:
    """Hashes ("bits") and small copies ("pictures") of what a training leaves."""
    threads = torch.get_num_threads()
    before = {(module, name): getattr(module, name) for module, name in FEWER}
    torch.set_num_threads(1)
    for (module, constant), fewer in FEWER.items():
        setattr(module, constant, fewer)
    try:
        run = univoxel.train(CASES[name](folder))
        with safe_open(run / "scene.safetensors", "np") as file:
            tensors = {key: file.get_tensor(key) for key in sorted(file.keys())}
        # The training light is a map like any other: it shows the scene as it was, near enough
        lit = {
            of: np.asarray(univoxel.relight(run, DATA / "envmaps" / f"{light}.hdr", samples=16)[0])
            for of, light in (("render", "train"), ("relit", "city"))
        }
    finally:
        torch.set_num_threads(threads)
        for (module, constant), usual in before.items():
            setattr(module, constant, usual)
    preview = np.frombuffer((run / "preview.png").read_bytes(), np.uint8)
    bits = {
        "names": hashlib.sha256(" ".join(tensors).encode()).hexdigest(),
        "parameters": digest(*tensors.values()),
        "preview": digest(preview),
        **{of: digest(picture) for of, picture in lit.items()},
    }
    return {"bits": bits, "pictures": {of: small(picture) for of, picture in lit.items()}}


def compare(base: Path, here: Path) -> int:
    """Print where two files of `made` differ; how many of their cases do."""
    before, now = (json.loads(path.read_text()) for path in (base, here))
    differing = 0
    for name in before.keys() | now.keys():
        if name not in before or name not in now:
            print(f"{name}: only in {'BASE' if name in before else 'the working tree'}")
            continue
        b, n = before[name], now[name]
        parts = [of for of in b["bits"] if b["bits"][of] != n["bits"].get(of)]
        differing += bool(parts)
        apart = ", ".join(
            f"{of} {distance_db(b['pictures'][of], n['pictures'][of]):.1f} dB"
            for of in b["pictures"]
        )
        print(f"{name}: " + (f"{', '.join(parts)} differ; {apart}" if parts else "the same bits"))
    return differing


def main() -> None:
    if sys.argv[1:2] == ["--compare"]:
        sys.exit(min(compare(Path(sys.argv[2]), Path(sys.argv[3])), 1))
    found = {}
    for name in CASES:
        with tempfile.TemporaryDirectory() as folder:
            found[name] = made(name, Path(folder))
    Path(sys.argv[1]).write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
