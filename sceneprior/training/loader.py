"""Data loaders whose order depends on seed and epoch alone, for any number of processes."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from torch.utils.data import DataLoader, Sampler, default_convert

from sceneprior.core.dataset import BLANK


class DrawSampler(Sampler[list[tuple[int, int]]]):
    """Samples batches of (row, epoch) in a new order each epoch, split over processes.

    In each step, the `world` processes together draw the rows that a single process with a `world`
    times larger `batch_size` would draw; `rank` is the index of this process. If the last batch has
    fewer rows than there are processes, each process without a row gets a draw of the epoch
    `BLANK`, for which the data set returns an empty room.
    """

    def __init__(self, rows: int, batch_size: int, seed: int, rank: int = 0, world: int = 1):
        self.rows, self.batch_size, self.seed = rows, batch_size, seed
        self.rank, self.world = rank, world
        self.epoch = 0
        # Lightning sets the epoch of a loader's `sampler` and of its `batch_sampler.sampler`, but
        # not of the `batch_sampler`, so this batch sampler is also its own `sampler`.
        self.sampler = self

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch (called by Lightning before each epoch)."""
        self.epoch = epoch

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
) -> DataLoader:
    """Make a loader of `SceneViews` (from a `ViewDataset`) or `RoomBoxes` (of true boxes).

    `workers` processes prefetch masks. Without masks, no workers are used, because boxes and
    cameras are already in memory or on the GPU.
    """
    workers = 0 if dataset.masks is None else workers
    return DataLoader(
        dataset,
        batch_sampler=DrawSampler(len(dataset), batch_size, seed, rank, world),
        collate_fn=default_convert,
        num_workers=workers,
        persistent_workers=workers > 0,
        multiprocessing_context="spawn" if workers else None,
    )
