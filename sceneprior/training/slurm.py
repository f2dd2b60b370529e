"""SLURM: leave a job in time and have it queued again (docs/cluster.md)."""

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
    """Whether this is the process that writes, of however many, on however many nodes."""
    return getattr(rank_zero_only, "rank", 0) == 0


def slurm_plugins() -> list[Any]:
    """Lightning's view of SLURM, without its requeue.

    That one saves in the middle of an epoch, where a run cannot be taken up exactly, and under
    the current folder, where the next stage would take the file for its own.
    """
    return [SLURMEnvironment(auto_requeue=False)] if SLURMEnvironment.detect() else []


@contextmanager
def requeue_on_signal() -> Iterator[None]:
    """In a SLURM job, answer SIGUSR1 by queueing the job again and stopping as Ctrl-C does.

    Nothing needs saving then: `last.ckpt` is as old as the last whole epoch, and a resumed run
    repeats the one that was cut short, view for view. SIGTERM, which SLURM sends before it
    preempts a job that it queues again itself, stops after the batch at hand.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    if not (SLURMEnvironment.detect() and in_main_thread):
        yield
        return

    def leave(number: int, frame: object) -> None:
        signal.signal(number, signal.SIG_IGN)  # srun may pass it on a second time
        if first_process():
            # First, while there is time: SLURM answers it with SIGTERM.
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
