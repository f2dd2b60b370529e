"""SLURM: stop a job in time and requeue it (docs/cluster.md)."""

import os
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from lightning.pytorch.plugins.environments import SLURMEnvironment
from lightning.pytorch.utilities import rank_zero_only


def first_process() -> bool:
    """True in the process that writes files: rank 0 over all nodes."""
    return getattr(rank_zero_only, "rank", 0) == 0


def slurm_plugins() -> list[Any]:
    """Lightning's SLURM environment, with requeueing turned off.

    Lightning's requeueing saves in the middle of an epoch, where a run cannot be resumed exactly,
    and into the current folder, where the next stage would mistake the file for its own.
    """
    return [SLURMEnvironment(auto_requeue=False)] if SLURMEnvironment.detect() else []


@contextmanager
def requeue_on_signal() -> Iterator[None]:
    """In a SLURM job, handle SIGUSR1 by requeueing the job and stopping as Ctrl-C does.

    Nothing needs to be saved at that point: `last.ckpt` holds the state after the last complete
    epoch, and a resumed run repeats the interrupted epoch with the same views. SIGTERM, which SLURM
    sends before it preempts and requeues a job itself, stops training after the current batch.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    if not (SLURMEnvironment.detect() and in_main_thread):
        yield
        return

    def leave(number: int, frame: object) -> None:
        signal.signal(number, signal.SIG_IGN)  # srun may send the signal twice
        if first_process():
            # Requeued first, while there is time: SLURM then sends SIGTERM.
            subprocess.run(["scontrol", "requeue", _job()], check=False)
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGUSR1, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGUSR1, before)


def _job() -> str:
    array = os.environ.get("SLURM_ARRAY_JOB_ID")
    if array is not None:
        return f"{array}_{os.environ['SLURM_ARRAY_TASK_ID']}"
    return os.environ["SLURM_JOB_ID"]
