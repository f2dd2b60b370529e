"""Loaders whose order depends on seed and epoch alone, over any number of processes."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from torch.utils.data import DataLoader, Sampler

from sceneprior.data.dataset import BLANK


class DrawSampler(Sampler[list[tuple[int, int]]]):
    """Batches of (row, epoch): a fresh order each epoch, split over processes.

    Several processes together draw the batches that one process would draw with a `batch_size`
    as many times as large. A last batch with fewer rows than processes is filled up with draws
    of an epoch `BLANK`, which the data set answers with a room in which there is nothing.
    `rank` is this process, of `world`.
    """

    def __init__(self, rows: int, batch_size: int, seed: int, rank: int = 0, world: int = 1):
        self.rows, self.batch_size, self.seed = rows, batch_size, seed
        self.rank, self.world = rank, world
        self.epoch = 0
        # Lightning tells the epoch to a loader's `sampler` and to its `batch_sampler.sampler`,
        # never to the batch sampler itself, which is what this is.
        self.sampler = self

    def set_epoch(self, epoch: int) -> None:
        """Lightning calls this before each epoch."""
        self.epoch = epoch

    def __len__(self) -> int:
        return -(-self.rows // (self.batch_size * self.world))

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        order = np.random.default_rng([self.seed, self.epoch]).permutation(self.rows)
        step = self.batch_size * self.world
        for start in range(0, self.rows, step):
            batch = order[start : start + step]
            mine = batch[self.rank :: self.world]
            # A process without a batch would leave the others waiting for it.
            yield [(int(row), self.epoch) for row in mine] or [(int(batch[0]), BLANK)]


def _as_it_is(batch: Any) -> Any:
    return batch


def make_loader(
    dataset: Any,
    batch_size: int,
    seed: int,
    workers: int,
    rank: int = 0,
    world: int = 1,
) -> DataLoader:
    """A loader of whole batches: `SceneViews` of a `ViewDataset`, or `RoomBoxes` of true boxes.

    `workers` read masks ahead. Without masks there is nothing to read: boxes and cameras are in
    memory, on the GPU perhaps, and no worker process stands between them and the step.
    """
    workers = 0 if dataset.masks is None else workers
    return DataLoader(
        dataset,
        batch_sampler=DrawSampler(len(dataset), batch_size, seed, rank, world),
        collate_fn=_as_it_is,
        num_workers=workers,
        persistent_workers=workers > 0,
        multiprocessing_context="spawn" if workers else None,
    )
