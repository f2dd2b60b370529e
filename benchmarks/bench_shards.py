"""Size of shards, and speed of loading batches from them.

    python benchmarks/bench_shards.py [--shards DIR] [--json FILE]

Without `--shards`, 48 bedrooms of procedural homes are prepared first. A batch has 16 scenes x 20
views with masks at a quarter of the size, read and collated by one process. The variants are

- cold: no view was read before (but all files are in the operating system's cache);
- again: masks are in the loader's packed store, as in every epoch but the first;
- layout: 16 and 128 scenes without masks, from memory.

The variants alternate; values are medians.
"""

import argparse
import sys
import tempfile
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from harness import machine, medians, report
from timed_fit import made_shards

from sceneprior.core.dataset import FlatViews, ViewDataset
from sceneprior.core.shards import iterate_rooms, list_shards

SCENES, VIEWS, STEP = 16, 20, 4
CLASSES = 22


def sizes(shards: Path) -> dict[str, float]:
    """Bytes per view of the shard files, and of the images in them."""
    paths = list_shards(shards, "train")
    total, images, views = sum(path.stat().st_size for path in paths), 0, 0
    for path in paths:
        with h5py.File(path) as file:
            for room in file["rooms"].values():
                images += room["instance_ids"].id.get_storage_size()
                views += len(room["instance_ids"])
    return {
        "views": views,
        "bytes_per_view": total / views,
        "image_bytes_per_view": images / views,
        "views_per_room": views / sum(1 for _ in iterate_rooms(shards, "train")),
    }


def memory(shards: Path) -> dict[str, float]:
    """Memory in MB that the loader needs per 100,000 views."""
    flat = FlatViews.of([shard.read_room(room) for shard, room in iterate_rooms(shards, "train")])
    views = len(flat.world_to_camera)
    data = ViewDataset(shards, "train", VIEWS, mask_step=STEP)
    assert data.masks is not None
    for room in range(len(data)):
        data.masks.read(room, np.arange(len(data._allowed[room])))
    packed = [image for room in data.masks._packed.values() for image in room.values()]
    return {
        "boxes_and_cameras_mb_per_100k_views": sum(
            getattr(flat, item.name).nbytes for item in fields(flat)
        ) / views / 10,
        "masks_mb_per_100k_views": sum(map(sys.getsizeof, packed)) / views / 10,
    }  # fmt: skip


def speeds(shards: Path, repeats: int) -> dict[str, float]:
    """Median milliseconds per batch of each variant."""
    warm = ViewDataset(shards, "train", VIEWS, mask_step=STEP)
    layout = ViewDataset(shards, "train", VIEWS, rotations=4)
    assert warm.masks is not None
    for row in range(SCENES):
        warm.masks.read(row, np.arange(len(warm._allowed[row])))

    def steps(epoch: int) -> dict[str, Callable[[], object]]:
        fresh = ViewDataset(shards, "train", VIEWS, mask_step=STEP)
        draws = [(row, epoch) for row in range(SCENES)]
        many = [(row % len(layout), epoch) for row in range(128)]
        return {
            "cold_ms": lambda: fresh.__getitems__(draws),
            "again_ms": lambda: warm.__getitems__(draws),
            "layout_16_ms": lambda: layout.__getitems__(draws),
            "layout_128_ms": lambda: layout.__getitems__(many),
        }

    found = medians(steps, repeats)
    return {name: 1000 * seconds for name, seconds in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--shards", type=Path, help="shards to measure (default: homes are made)")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--json", type=Path, help="also write the numbers to this file")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    figures: dict[str, Any] = machine()
    with tempfile.TemporaryDirectory() as name:
        shards = arguments.shards or made_shards(Path(name), 48, workers=1)
        figures |= sizes(shards) | memory(shards) | speeds(shards, arguments.repeats)
    report(figures, arguments.json)


if __name__ == "__main__":
    main()
