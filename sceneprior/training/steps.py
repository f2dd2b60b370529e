"""Shared parts of the training steps of all methods: order of batches, weighted sum, checks, seeds,
precision, schedule."""

import math
import shutil
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch import distributed as dist
from torch.utils.data import DataLoader, Sampler, default_convert

from sceneprior.core.dataset import BLANK
from sceneprior.core.errors import InputWarning
from sceneprior.core.settings import Section

if TYPE_CHECKING:  # importing Lightning takes longer than the rest of loading a prior
    import lightning.pytorch.utilities.types

LOADER_TIMEOUT_S = 600
"""Time without a batch after which training with worker processes ends with an error."""


class DrawSampler(Sampler[list[tuple[int, int]]]):
    """Samples batches of (row, epoch) in a new order each epoch, split over processes.

    In each step, the `world` processes together draw the rows that a single process with a `world`
    times larger `batch_size` would draw; `rank` is the index of this process. If the last batch has
    fewer rows than there are processes, each process without a row gets a draw of the epoch
    `BLANK`, for which the data set returns an empty room. If `repeated`, every epoch is the first.
    """

    def __init__(
        self,
        rows: int,
        batch_size: int,
        seed: int,
        rank: int = 0,
        world: int = 1,
        repeated: bool = False,
    ):
        self.rows, self.batch_size, self.seed = rows, batch_size, seed
        self.rank, self.world, self.repeated = rank, world, repeated
        self.epoch = 0
        # Lightning sets the epoch of a loader's `sampler` and of its `batch_sampler.sampler`, but
        # not of the `batch_sampler`, so this batch sampler is also its own `sampler`.
        self.sampler = self

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch (called by Lightning before each epoch)."""
        self.epoch = 0 if self.repeated else epoch

    def __len__(self) -> int:
        return -(-self.rows // (self.batch_size * self.world))

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        order = np.random.default_rng([self.seed, self.epoch]).permutation(self.rows)
        step = self.batch_size * self.world
        for start in range(0, self.rows, step):
            batch = order[start : start + step]
            mine = batch[self.rank :: self.world]
            # A process without a batch would make the others wait forever.
            yield [(int(row), self.epoch) for row in mine] or [(int(batch[0]), BLANK)]


def make_loader(
    dataset: Any,
    batch_size: int,
    seed: int,
    workers: int,
    rank: int = 0,
    world: int = 1,
    repeated: bool = False,
) -> DataLoader:
    """Make a loader of `SceneViews` (from a `ViewDataset`) or `RoomBoxes` (of true boxes).

    `workers` processes prefetch masks. Without masks, no workers are used, because boxes and
    cameras are already in memory or on the GPU; nor are they if shared memory, through which they
    pass batches, is too small.
    """
    workers = 0 if dataset.masks is None else workers
    sampler = DrawSampler(len(dataset), batch_size, seed, rank, world, repeated)
    if workers and _overfill_shared_memory(dataset.__getitems__(next(iter(sampler))), workers):
        workers = 0
    return DataLoader(
        dataset,
        batch_sampler=sampler,
        collate_fn=default_convert,
        num_workers=workers,
        persistent_workers=workers > 0,
        timeout=LOADER_TIMEOUT_S if workers else 0,
        multiprocessing_context="spawn" if workers else None,
    )


def _overfill_shared_memory(batch: Any, workers: int) -> bool:
    """True, with a warning, if the batches that workers prefetch do not fit into /dev/shm."""
    each = sum(value.nbytes for value in vars(batch).values() if isinstance(value, Tensor))
    needed = (2 * workers + 1) * each  # torch's prefetch factor is 2
    free = shutil.disk_usage("/dev/shm").free if Path("/dev/shm").is_dir() else needed
    if needed > free:
        said = f"need {needed / 2**20:.0f} MB of shared memory, and /dev/shm has {free / 2**20:.0f}"
        then = "enlarge it (docker run --shm-size 2g), or set data.workers to 0"
        warnings.warn(f"{workers} workers {said}, so none are used; {then}.", InputWarning, 3)
    return needed > free


def weighted_sum(
    losses: dict[str, Float[Tensor, "*rooms"]], weights: Section
) -> Float[Tensor, "*rooms"]:
    """The weighted sum of losses, one number or one per room: Eq. 7 with the layout losses.

        L = sum_t lambda_t L_t

    `weights` has a key lambda_t for each L_t.
    """
    by_name = weights.model_dump(by_alias=True)
    return torch.stack([by_name[name] * loss for name, loss in losses.items()]).sum(dim=0)


def check_finite(total: Tensor, room_ids: tuple[str, ...]) -> None:
    """Raise a `FloatingPointError` that names the batch's rooms if the total loss is not finite.

    All processes stop together: if one stopped alone, the others would wait for it.
    """
    value = total.item()
    finite = math.isfinite(value)
    told = [(value, () if finite else room_ids)]
    if dist.is_available() and dist.is_initialized():
        worst = torch.tensor(int(finite), device=total.device)
        dist.all_reduce(worst, dist.ReduceOp.MIN)
        finite = bool(worst)
        if not finite:
            told *= dist.get_world_size()
            dist.all_gather_object(told, told[0])
    if finite:
        return
    value = next((bad for bad, rooms in told if rooms), value)
    raise FloatingPointError(
        f"The loss is {value} on rooms {', '.join(room for _, rooms in told for room in rooms)}; "
        "lower the learning rate, or look at these rooms with `sceneprior inspect`."
    )


def full_precision(device: torch.device) -> torch.autocast:
    """Context that turns mixed precision off, for latents, projections, matching, silhouettes and
    losses. Only the networks may run in lower precision."""
    return torch.autocast(device.type, enabled=False)


def batch_seed(seed: int, trainer: "lightning.Trainer", batch_idx: int) -> int:
    """A distinct seed for each batch and process; a resumed run gets the same seeds."""
    batch = trainer.current_epoch * int(trainer.num_training_batches) + batch_idx
    sequence = np.random.SeedSequence([seed, batch, trainer.global_rank])
    return int(sequence.generate_state(1, np.uint64)[0] >> 1)


def log_losses(
    module: "lightning.LightningModule", values: dict[str, Tensor], total: Tensor, rooms: int
) -> None:
    """Log means over an epoch and all processes, as `train/<name>` and `train/loss`; in evaluation
    mode as `val/*`, or in the group `module.log_as`, which is empty for no log.

    In training, they are summed here, and given to Lightning in the last step of an epoch: a call
    of its `log` takes a millisecond, and a step on a GPU ten.
    """
    values = values | {"loss": total}
    how: dict[str, Any] = {"on_step": False, "on_epoch": True, "sync_dist": True}
    how["add_dataloader_idx"] = False
    if not module.training:
        group = getattr(module, "log_as", "val")
        named = {f"{group}/{name}": value for name, value in values.items() if group}
        module.log_dict(named, batch_size=rooms, **how)
        return
    trainer = module.trainer
    sums: dict[str, tuple[Tensor | float, int]] = module.__dict__.setdefault("epoch_sums", {})
    for name, value in values.items():
        summed, number = sums.get(name, (0.0, 0))
        sums[name] = summed + value.detach() * rooms, number + rooms
    if trainer.is_last_batch or 0 < trainer.max_steps <= trainer.global_step + 1:
        for name, (summed, number) in sums.items():
            module.log(f"train/{name}", summed / number, batch_size=number, **how)
        sums.clear()


def with_cosine(
    optimizer: torch.optim.Optimizer, steps: int
) -> "lightning.pytorch.utilities.types.OptimizerLRSchedulerConfig":
    """The optimiser with a schedule: learning rates rise during the first twentieth of `steps`, and
    then fall to 0 along a cosine."""
    rise = torch.optim.lr_scheduler.OneCycleLR(
        optimizer,
        [group["lr"] for group in optimizer.param_groups],
        total_steps=steps + 1,
        pct_start=0.05,
        cycle_momentum=False,
    )
    return {"optimizer": optimizer, "lr_scheduler": {"scheduler": rise, "interval": "step"}}
