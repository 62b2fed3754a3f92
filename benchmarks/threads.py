"""What the second core brings to a whole training, by its stages.

    python benchmarks/threads.py SCENE [--preset fast]

The same training four times: on one thread; on two; twice on one thread, side by side, which is
what two programs that know nothing of each other get out of two cores; and on two threads that
sleep at once instead of waiting. Everything else on the machine should be at rest.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from made import made

HERE = Path(__file__).parent
LIMIT = 60.0  # minutes: no machine is too slow for all steps
REST = "before, between and after"


def measure(scene: Path, preset: str, folder: Path, threads: int) -> list[list]:
    """Name, seconds on the clock and seconds of the processor of each stage of a training here."""
    import torch

    from univoxel.cli import trainer
    from univoxel.config import JointConfig
    from univoxel.presets import chosen

    torch.set_num_threads(threads)
    cfg = chosen(preset, LIMIT, scene, folder)
    run_stage, spent = trainer.make_stage_, []

    def now() -> tuple[float, float]:
        return time.perf_counter(), time.process_time()

    def timed(model, limited, index, *rest):
        begin = now()
        run_stage(model, limited, index, *rest)
        stage = limited.stages[index]
        if isinstance(stage, JointConfig):
            name = "joint solve"
        else:
            name = f"{'refit' if stage.refit else 'grid'}, {stage.voxels:g} M"
        spent.append([f"{index + 1}: {name}", *(b - a for a, b in zip(begin, now(), strict=True))])

    trainer.make_stage_ = timed
    begin = now()
    trainer.train(cfg)
    whole = [b - a for a, b in zip(begin, now(), strict=True)]
    rest = [w - sum(s[1 + i] for s in spent) for i, w in enumerate(whole)]
    return [*spent, [REST, *rest], ["whole", *whole]]


def trainings(options: argparse.Namespace, threads: int, count: int = 1, **extra: str) -> list:
    """`measure`, in processes of their own side by side."""
    from univoxel.cli import SPINS

    environment = {k: v for k, v in os.environ.items() if k != "OMP_WAIT_POLICY"}  # of the caller
    environment |= extra or {"GOMP_SPINCOUNT": SPINS}
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, __file__, str(options.scene), "--preset", options.preset]
        command += ["--threads", str(threads), "--run"]
        started = [
            subprocess.Popen(
                [*command, f"{folder}/{k}"], env=environment, stdout=subprocess.PIPE, text=True
            )
            for k in range(count)
        ]
        told = [process.communicate()[0] for process in started]
        if any(process.returncode for process in started):
            raise SystemExit("a training failed")
        return [json.loads(text.splitlines()[-1]) for text in told]


def result(one: list, two: list, pair: list, passive: list) -> dict:
    """As a file of results, see CONTRIBUTING.md."""
    rows = []
    for k, (name, wall, _) in enumerate(one):
        beside = sum(run[k][1] for run in pair) / len(pair)
        gain, core = wall / two[k][1], len(pair) * wall / beside
        rows.append([name, wall, *two[k][1:], gain, beside, core, gain / core, passive[k][1]])
    seconds = {"unit": "s", "digits": 1}
    columns = [
        {"name": "stage"},
        {"name": "one thread"} | seconds,
        {"name": "two threads"} | seconds,
        {"name": "processor time of both"} | seconds,
        {"name": "gain", "digits": 2},
        {"name": "one of two programs"} | seconds,
        {"name": "gain of a core", "digits": 2},
        {"name": "share", "digits": 2},
        {"name": "two threads, `OMP_WAIT_POLICY=passive`"} | seconds,
    ]
    return {"columns": columns, "rows": rows}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="folder of photographs")
    parser.add_argument("--preset", default="fast", help="such as draft (default: fast)")
    parser.add_argument("--out", type=Path, default=HERE / "results" / "threads.json")
    parser.add_argument("--run", type=Path, help=argparse.SUPPRESS)  # of one training: its folder
    parser.add_argument("--threads", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.run:
        print(json.dumps(measure(options.scene, options.preset, options.run, options.threads)))
        return
    from lab.record import result_text

    (one,), (two,) = trainings(options, 1), trainings(options, 2)
    pair = trainings(options, 1, count=2)
    (passive,) = trainings(options, 2, OMP_WAIT_POLICY="passive")
    about = {
        "title": "A whole training on one thread, on two, and twice side by side",
        **made(),
        "note": f"{options.scene.name}, `{options.preset}`, all steps. Gain of a core: work of "
        "two programs side by side over that of one. Share: the part of this gain that the second "
        "thread of one program reaches.",
    }
    found = about | result(one, two, pair, passive)
    options.out.write_text(result_text(found))
    print(result_text(found))


if __name__ == "__main__":
    main()
