"""SLURM: which process writes files, and who queues a job again (docs/cluster.md)."""

from typing import Any

from lightning.pytorch.plugins.environments import SLURMEnvironment
from lightning.pytorch.utilities import rank_zero_only


def first_process() -> bool:
    """True in the process that writes files: rank 0 over all nodes."""
    return getattr(rank_zero_only, "rank", 0) == 0


def slurm_plugins() -> list[Any]:
    """Lightning's SLURM environment, without its own requeueing.

    Lightning's requeueing saves in the middle of an epoch, where a run cannot be resumed exactly,
    and into the current folder, where the next stage would mistake the file for its own.
    """
    return [SLURMEnvironment(auto_requeue=False)] if SLURMEnvironment.detect() else []
