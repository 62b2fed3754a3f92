"""A training in several processes against the same in one, and what becomes of it when one dies."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

import univoxel
from univoxel import ranks
from univoxel.checkpoint import load_checkpoint
from univoxel.color import linear_to_srgb
from univoxel.data import load_photos
from univoxel.errors import ProcessFailed, UserError
from univoxel.metrics import psnr
from univoxel.presets import preset
from univoxel.render.pipeline import shade_hits, surface_of_view
from univoxel.tasks.train import train
from univoxel.training.exchange import summed_over_ranks_

DATA = Path(univoxel.__file__).parent / "example_data" / "tiny"
WORKER = Path(__file__).parent / "rank_worker.py"
# All stages, in few steps, and with more time than they want
FEW = (
    *("stages.0.voxels=0.05", "stages.0.iterations=30", "stages.0.rays=256"),
    *("stages.1.voxels=0.1", "stages.1.iterations=30", "stages.1.rays=256"),
    *("stages.2.iterations=20", "stages.2.rays=256", "stages.2.points=1500"),
    *("stages.2.newton_points=600", "stages.2.rounds=2"),
    *("stages.3.voxels=0.1", "stages.3.iterations=20", "stages.3.rays=256"),
)
TRAIN = (
    *("train", str(DATA), "--preset", "draft", "--minutes", "60", "--downscale", "2"),
    *("--capacity", "fixed", "--no-page", *(x for change in FEW for x in ("--set", change))),
)

# The first rank fails while the other is not there to see it
SLOW = """
import time
from univoxel import ranks
try:
    with ranks.joined():
        if ranks.rank() == 0:
            raise ValueError("a mistake")
        time.sleep(2)
        ranks.tick()
except Exception as error:
    print(error)
"""

# One process that draws what two ranks draw
IN_TWO_PARTS = """
import sys
from univoxel import cli
from univoxel.training import loop
parts_of = loop.parts_of
loop.parts_of = lambda pixels, rays, _: parts_of(pixels, rays, 2)
sys.exit(cli.main(sys.argv[1:]))
"""


def environment(**more: str) -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1", **more}


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def begin_ranks(command: list[str], count: int) -> list[subprocess.Popen[str]]:
    """The processes of a training, as torchrun begins them, without what torchrun says itself."""
    address = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port())}
    common = {**address, "WORLD_SIZE": str(count), "TORCHELASTIC_RUN_ID": "test"}
    return [
        subprocess.Popen(
            command,
            env=environment(**common, RANK=str(rank), LOCAL_RANK=str(rank)),
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        for rank in range(count)
    ]


def ended(processes: list[subprocess.Popen[str]]) -> list[tuple[int, str, str]]:
    """Exit code, stdout and stderr of each."""
    told = [p.communicate(timeout=500) for p in processes]
    return [(p.returncode, *said) for p, said in zip(processes, told, strict=True)]


def quality(run: Path) -> float:
    """PSNR in sRGB of two test views, dB."""
    scene, _ = load_checkpoint(run)
    photos = load_photos(DATA, "test", 2)
    drawn, seen = [], []
    for view in (0, 3):
        surface, wo = surface_of_view(scene, photos.cameras, view)
        drawn.append(linear_to_srgb(shade_hits(scene, surface, wo, view)).flatten())
        color, alpha = photos.picture(view)
        seen.append(linear_to_srgb(color * alpha[..., None]).flatten())
    return psnr(torch.cat(drawn), torch.cat(seen))


@pytest.fixture(scope="module")
def in_one(tmp_path_factory):
    out = tmp_path_factory.mktemp("ranks") / "one"
    command = [sys.executable, "-c", IN_TWO_PARTS, *TRAIN, "--out", str(out)]
    subprocess.run(command, env=environment(), check=True, capture_output=True)
    return out


def test_two_ranks_end_where_one_process_does(in_one, tmp_path):
    out = tmp_path / "two"
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    done = subprocess.run(
        [*torchrun, "-m", "univoxel.cli", *TRAIN, "--out", str(out)],
        env=environment(),
        text=True,
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("photographs of") == 1, "one rank speaks"
    assert {p.name for p in out.iterdir()} == {p.name for p in in_one.iterdir()}
    # The same draws, and sums in another order: measured 0.00 to 0.03
    assert abs(quality(out) - quality(in_one)) < 0.1
    state = load_checkpoint(out)[1]
    exchanged = state["ranks"]
    assert exchanged["count"] == 2
    assert exchanged["steps"] == 100
    # Each rank tells its rows once; where both touch one it travels twice
    assert exchanged["touched"] < exchanged["sent"] < 2 * exchanged["touched"]


def test_a_rank_that_dies_ends_the_run_with_a_line_and_one_process_goes_on(in_one, tmp_path):
    out = tmp_path / "killed"
    command = [sys.executable, "-m", "univoxel.cli", *TRAIN, "--out", str(out)]
    processes = begin_ranks(command, 2)
    while not (out / "scene.safetensors").exists():
        assert all(p.poll() is None for p in processes), ended(processes)
        time.sleep(0.02)
    processes[1].send_signal(signal.SIGKILL)
    (code, _, said), (killed, _, _) = ended(processes)
    assert killed == -signal.SIGKILL
    assert code == 2
    (line,) = [each for each in said.splitlines() if each.startswith("univoxel train:")]
    assert "another process of this training has ended" in line
    assert "--resume" in line
    assert "Traceback" not in said
    subprocess.run([*command, "--resume"], env=environment(), check=True, capture_output=True)
    assert load_checkpoint(out)[1]["stage"] == 4
    assert quality(out) > quality(in_one) - 1.5  # Adam begins anew where it goes on


def test_a_mistake_is_said_once(tmp_path):
    command = [sys.executable, "-m", "univoxel.cli", "train", str(tmp_path), "--out"]
    told = ended(begin_ranks([*command, str(tmp_path / "out")], 2))
    assert [code for code, _, _ in told] == [2, 2]
    lines = [line for _, _, said in told for line in said.splitlines() if "univoxel" in line]
    assert len(lines) == 1, lines
    assert "expected photographs with their cameras" in lines[0]


def test_a_mistake_is_said_once_to_a_rank_that_is_slow():
    told = ended(begin_ranks([sys.executable, "-c", SLOW], 2))
    assert told[0][:2] == (0, "a mistake\n"), told
    assert told[1][:2] == (2, ""), told


@pytest.mark.parametrize("said", [True, False])
def test_an_error_while_ranks_find_each_other_is_said_once(said, monkeypatch):
    store = torch.distributed.HashStore()
    store.add(ranks.ERRORS, int(said))

    def fail(*_, **__):
        raise RuntimeError("connection closed")

    for name in ("MASTER_ADDR", "MASTER_PORT", "TORCHELASTIC_RUN_ID", "RANK"):
        monkeypatch.setenv(name, "1")
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setattr(ranks, "rendezvous", lambda *_, **__: iter([(store, 1, 2)]))
    monkeypatch.setattr(torch.distributed, "init_process_group", fail)
    with pytest.raises(SystemExit if said else ProcessFailed), ranks.joined():
        pass
    assert store.add(ranks.ERRORS, 0) == 1 + said


def test_a_store_that_has_ended_is_not_waited_for():
    class Ended:
        def add(self, *_):
            raise RuntimeError("broken pipe")

    ranks._stay(Ended(), 2)


def test_a_look_at_the_training_is_of_one_process(tmp_path, monkeypatch):
    monkeypatch.delenv("MASTER_ADDR", raising=False)
    for name, value in {"TORCHELASTIC_RUN_ID": "x", "WORLD_SIZE": "2", "RANK": "1"}.items():
        monkeypatch.setenv(name, value)
    assert not ranks.leads()
    cfg = preset("draft", DATA, tmp_path / "out")
    with pytest.raises(UserError, match="view is of trainings in one process"):
        train(cfg, view=("127.0.0.1", 0))
    with pytest.raises(UserError, match="timelapse is of trainings in one process"):
        train(cfg, timelapse=tmp_path / "film.gif")
    with pytest.raises(ProcessFailed, match="MASTER_ADDR"):
        train(cfg)


def test_all_ranks_get_what_each_has_made():
    told = ended(begin_ranks([sys.executable, str(WORKER)], 3))
    assert [code for code, _, _ in told] == [0, 0, 0], told
    each = [json.loads(out) for _, out, _ in told]
    assert each[0] == each[1] == each[2]
    assert each[0]["gathered"] == [[10 * i, 2 * i] for i in range(7)]
    assert each[0]["spread"] == [[float(i)] * 2 for i in range(5)]
    assert each[0]["total"] == [0.0 + 1.0 + 2.0, 7.0]
    assert each[0]["as_first"] == 0.0
    # Rows 0, 1, 2 of ranks 0, 1, 2, and row 5 of all; a network's gradient of ranks 0 and 1
    assert each[0]["rows"] == [0, 1, 2, 5]
    assert each[0]["values"] == [[1.0, 1.0], [2.0, 2.0], [3.0, 3.0], [6.0, 6.0]]
    assert each[0]["dense"] == [3.0, 3.0, 3.0]
    assert each[0]["terms"] == {"a": 6.0, "b": 1.0}
    assert each[0]["none"] is None


def test_one_process_is_left_alone():
    parameter = torch.zeros(3, requires_grad=True)
    parameter.grad = torch.ones(3)
    terms = {"a": torch.ones(())}
    assert summed_over_ranks_([parameter], terms) is terms
    part = torch.ones(2)
    assert ranks.total(part) is part
    assert ranks.once(part) is part
    assert ranks.mine([1, 2, 3]) == [1, 2, 3]
    assert ranks.shared(lambda x: (2 * x,), torch.arange(2)) == [(0,), (2,)]
    assert (ranks.count(), ranks.rank(), ranks.leads()) == (1, 0, True)
    assert ranks.sent_bytes() == 0
    assert abs(ranks.now() - time.monotonic()) < 5
    with ranks.joined():
        assert ranks.count() == 1
