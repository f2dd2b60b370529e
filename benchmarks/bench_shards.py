"""Size of shards, and speed of loading batches from them.

    python benchmarks/bench_shards.py [--shards DIR] [--json FILE]

Without `--shards`, 48 bedrooms of procedural homes are prepared first. A batch has 16 scenes x 20
views with masks at a quarter of the size, read and collated by one process. The variants are

- cold: no view was read before (but all files are in the operating system's cache);
- again: masks are in the loader's packed store, as in every epoch but the first;
- layout: 16 and 128 scenes without masks, from memory;
- per-view files: one HDF5 file per view, read like the authors' released loader: each object's box,
  class, track and mask is read separately, drawn into an image, downsampled, and stacked view by
  view and room by room.

The variants alternate; values are medians, and ratios are within one run.
"""

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import torch
from timed_fit import made_shards
from torch.utils.data import default_collate

from sceneprior.core.dataset import FlatViews, ViewDataset
from sceneprior.core.shards import RoomViews, iterate_rooms, list_shards

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


def write_view_files(folder: Path, room: RoomViews) -> list[Path]:
    """Write one HDF5 file per view: camera, and each visible object's box, class, track, mask."""
    assert room.instance_ids is not None
    height, width = room.image_size
    paths = []
    for view, image in enumerate(room.instance_ids):
        paths.append(folder / f"{room.room_id.replace('/', '_')}_{view:04d}.hdf5")
        with h5py.File(paths[-1], "w") as file:
            file["room_type"] = np.array([b"bedroom"])
            file["cam_T"] = room.world_to_camera[view].astype(np.float64)
            file["cam_K"] = room.intrinsics[view].astype(np.float64)
            for k in np.flatnonzero(room.visible[view]):
                corners = room.boxes[view, k] * [width, height, width, height]
                left, top, right, bottom = corners.round().astype(int)
                one = file.create_group(f"inst_info/{k}")
                one["bbox2d"] = np.array([left, top, right - left, bottom - top])
                one["category_id"] = np.array([int(room.object_class[k])])
                one["inst_mark"] = np.array([str(k).encode()])
                mask = image[top:bottom, left:right] == k + 1
                one.create_dataset("mask", data=mask, compression="gzip")
    return paths


def read_view_file(path: Path, objects: int, image_size: tuple[int, int]) -> dict[str, Any]:
    """Read one view as arrays, padded to the room's number of tracked objects."""
    with h5py.File(path, "r") as file:
        _ = file["room_type"][0].decode()
        pose, lens = file["cam_T"][:], file["cam_K"][:]
        found = [
            (int(one["inst_mark"][0]), one["bbox2d"][:], one["category_id"][0], one["mask"][:])
            for one in file.get("inst_info", {}).values()
        ]
    boxes = np.full((objects, 4 + CLASSES), -1.0)
    boxes[:, 4:] = 0
    seen = np.zeros(objects, dtype=bool)
    ids = np.full(image_size, -1)
    for k, (left, top, width, height), category, mask in found:
        boxes[k, :4] = left, top, left + width - 1, top + height - 1
        boxes[k, 4 + category] = 1
        seen[k] = True
        ids[top : top + height, left : left + width][mask] = k
    size = (image_size[1] // STEP, image_size[0] // STEP)
    small = cv2.resize(ids.astype(np.int32), size, interpolation=cv2.INTER_NEAREST_EXACT)
    return {
        "pose": pose.astype(np.float32),
        "lens": lens.astype(np.float32),
        "boxes": boxes.astype(np.float32),
        "seen": seen,
        "ids": small.astype(np.int64),
    }


def batch_from_view_files(
    rooms: list[tuple[list[Path], int, tuple[int, int]]], seed: int
) -> dict[str, torch.Tensor]:
    """Stack 20 random views of each room, padded to the largest number of objects."""
    rng = np.random.default_rng(seed)
    widest = max(objects for _, objects, _ in rooms)
    scenes = []
    for paths, objects, size in rooms:
        chosen = rng.choice(len(paths), VIEWS, replace=len(paths) < VIEWS)
        views = [read_view_file(paths[view], objects, size) for view in chosen]
        for view in views:
            for name in ("boxes", "seen"):
                rest = np.zeros((widest - objects, *view[name].shape[1:]), view[name].dtype)
                view[name] = np.concatenate([view[name], rest])
        scenes.append(default_collate(views))
    return default_collate(scenes)


def speeds(shards: Path, folder: Path, repeats: int) -> dict[str, float]:
    """Median milliseconds per batch of each variant."""
    chosen = []
    for shard, room_id in iterate_rooms(shards, "train"):
        room = shard.read_room(room_id, images=True)
        chosen.append((write_view_files(folder, room), len(room.object_class), room.image_size))
        if len(chosen) == SCENES:
            break
    warm = ViewDataset(shards, "train", VIEWS, mask_step=STEP)
    layout = ViewDataset(shards, "train", VIEWS, rotations=4)
    rows = list(range(SCENES))
    assert warm.masks is not None
    for row in rows:
        warm.masks.read(row, np.arange(len(warm._allowed[row])))
    times: dict[str, list[float]] = {}

    def timed(name: str, call: Callable[[], object]) -> None:
        before = time.perf_counter()
        call()
        times.setdefault(name, []).append(1000 * (time.perf_counter() - before))

    for epoch in range(repeats):
        fresh = ViewDataset(shards, "train", VIEWS, mask_step=STEP)
        draws = [(row, epoch) for row in rows]
        many = [(row % len(layout), epoch) for row in range(128)]
        timed("per_view_files_ms", lambda: batch_from_view_files(chosen, epoch))  # noqa: B023
        timed("cold_ms", lambda: fresh.__getitems__(draws))  # noqa: B023
        timed("again_ms", lambda: warm.__getitems__(draws))  # noqa: B023
        timed("layout_16_ms", lambda: layout.__getitems__(draws))  # noqa: B023
        timed("layout_128_ms", lambda: layout.__getitems__(many))  # noqa: B023
    found = {name: statistics.median(values) for name, values in times.items()}
    base = found["per_view_files_ms"]
    found |= {
        "files_over_cold": base / found["cold_ms"],
        "files_over_again": base / found["again_ms"],
        "files_over_layout": base / found["layout_16_ms"],
    }
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--shards", type=Path, help="shards to measure (default: homes are made)")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--json", type=Path, help="also write the numbers to this file")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    figures: dict[str, Any] = {"cores": os.cpu_count(), "load_average": os.getloadavg()}
    with tempfile.TemporaryDirectory() as name:
        shards = arguments.shards or made_shards(Path(name), 48, workers=1)
        views = Path(name) / "views"
        views.mkdir()
        figures |= sizes(shards) | memory(shards) | speeds(shards, views, arguments.repeats)
    for key, value in figures.items():
        print(f"{key:38}", f"{value:.4g}" if isinstance(value, float) else value)
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
