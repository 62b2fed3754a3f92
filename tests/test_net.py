"""The net under every move and rename: trainings with fixed steps end in the same bits.

Three short trainings of the bundled scene, each with other parts of the program, on one thread and
under a budget of time that cuts nothing. Of each the hashes of the model's tensors, of a rendered
picture and of a relit frame are held in tests/net.json, by processor and torch: other processors
round otherwise. On a processor that is not held, the pictures are compared with small copies.

    python tests/test_net.py    # hold what the present code makes on this machine
"""

import dataclasses
import hashlib
import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open

import univoxel
from univoxel.config import TrainConfig
from univoxel.ops import native
from univoxel.presets import preset, with_field

HELD = Path(__file__).parent / "net.json"
DATA = Path(univoxel.__file__).parent / "example_data" / "tiny"
# Rounding that differs grows in training. The builds for AVX2 and for any processor make pictures
# that are 31 dB and more apart; a training whose light or materials are broken falls below this.
ALIKE_DB = 25.0
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
    return dataclasses.replace(cfg, stages=tuple(stages), minutes=1e6, downscale=2, **changes)


def hybrid(out: Path) -> TrainConfig:
    """Everything that the presets do, with cameras refined and exposures."""
    cfg = short(preset("fast", DATA, out), cameras="refined", voxel_pixels=0.5)
    return dataclasses.replace(cfg, scene=dataclasses.replace(cfg.scene, varying="exposure"))


def varying(out: Path) -> TrainConfig:
    """Light that varies, and rehearsals on dense grids under a budget."""
    cfg = with_field(preset("draft", DATA, out, varying="light"), "dense")
    return short(cfg, capacity="adaptive", budget_mb=0.5)


def sparse(out: Path) -> TrainConfig:
    """Bricks, and lobes alone."""
    return short(with_field(preset("draft", DATA, out, "sg"), "sparse"))


CASES = {"hybrid": hybrid, "varying": varying, "sparse": sparse}


def processor() -> str:
    """What the bits depend on beside the code."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    keys = ("model name", "cpu family", "model\t", "stepping")
    found = [next((x.split(":")[1].strip() for x in lines if x.startswith(k)), "") for k in keys]
    built = native.variant if native.core else "no extension"
    return ", ".join([*found, f"torch {torch.__version__}", f"extension {built}"])


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


def pixels(copy: str) -> np.ndarray:
    return np.frombuffer(bytes.fromhex(copy), np.uint8) / 255


def made(name: str, folder: Path) -> dict:
    """Hashes and small copies of what a training leaves."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        run = univoxel.train(CASES[name](folder))
        with safe_open(run / "scene.safetensors", "np") as file:
            tensors = {key: file.get_tensor(key) for key in sorted(file.keys())}
        # The training light is a map like any other: it shows the scene as it was, near enough
        lit = {
            of: univoxel.relight(run, DATA / "envmaps" / f"{of}.hdr", samples=16)[0]
            for of in ("train", "city")
        }
    finally:
        torch.set_num_threads(threads)
    pictures = {"render": np.asarray(lit["train"]), "relit": np.asarray(lit["city"])}
    preview = np.frombuffer((run / "preview.png").read_bytes(), np.uint8)
    return {
        "parameters": digest(*tensors.values()),
        "preview": digest(preview),
        **{key: digest(picture) for key, picture in pictures.items()},
        "copies": {key: small(picture) for key, picture in pictures.items()},
    }


@pytest.mark.parametrize("name", CASES)
def test_training_ends_in_the_same_bits(name, tmp_path):
    held, found = json.loads(HELD.read_text())[name], made(name, tmp_path)
    copies = found.pop("copies")
    if processor() in held["bits"]:
        assert found == held["bits"][processor()]
        return
    for key, copy in copies.items():
        error = np.square(pixels(copy) - pixels(held["copies"][key])).mean()
        assert -10 * np.log10(max(error, 1e-9)) > ALIKE_DB, key


def hold() -> None:
    """Write what the present code makes on this machine; other machines' lines stay if none of
    this machine's has changed."""
    import tempfile

    held = json.loads(HELD.read_text()) if HELD.exists() else {}
    for name in CASES:
        with tempfile.TemporaryDirectory() as folder:
            found = made(name, Path(folder))
        copies, before = found.pop("copies"), held.get(name, {"bits": {}})
        changed = before["bits"].get(processor(), found) != found
        bits = {processor(): found} if changed else before["bits"] | {processor(): found}
        held[name] = {"bits": bits, "copies": copies}
    lines = json.dumps(held, indent=1, sort_keys=True)
    HELD.write_text(lines + "\n")


if __name__ == "__main__":
    hold()
