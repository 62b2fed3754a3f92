"""Take scenes through `univoxel batch` on a cluster under Slurm, each in a job of its own.

    pip install 'univoxel[cluster]' dask-jobqueue
    python slurm_batch.py scenes/* --out night --minutes 10

Run it on a machine that may submit jobs, and that sees scenes and results at the same paths as the
jobs do. For PBS or LSF take `PBSCluster` or `LSFCluster`: their options are alike. The same command
goes on after an interruption.
"""

from __future__ import annotations

import subprocess
import sys

from dask_jobqueue import SLURMCluster

JOBS = 20  # at most, each with one scene at a time
CORES = 8  # of each
MEMORY = "16GB"  # of each
HOURS = 8  # after which a job ends; another goes on with its scene

if __name__ == "__main__":
    cluster = SLURMCluster(
        cores=1,  # of Dask, which counts scenes at once
        processes=1,
        job_cpu=CORES,
        memory=MEMORY,
        walltime=f"{HOURS:02d}:00:00",
        # What ends a little before its time is up is not taken for a crash
        worker_extra_args=["--lifetime", f"{60 * HOURS - 5}m", "--lifetime-stagger", "2m"],
    )
    cluster.adapt(minimum=0, maximum=JOBS)
    command = [sys.executable, "-m", "univoxel.cli", "batch", *sys.argv[1:]]
    command += ["--scheduler", cluster.scheduler_address, "--threads", str(CORES)]
    with cluster:
        sys.exit(subprocess.run(command).returncode)
