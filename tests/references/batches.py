"""Batches of views, one room at a time: what `ViewDataset` gathers, spelled out."""

from pathlib import Path
from typing import Any

import numpy as np

from sceneprior.core.observations import RoomViews
from sceneprior.core.shards import iterate_rooms


def rooms_with_images(folder: Path, split: str) -> list[RoomViews]:
    return [
        shard.read_room(room_id, images=True) for shard, room_id in iterate_rooms(folder, split)
    ]


def allowed_views(index: int, count: int, fraction: float, seed: int) -> np.ndarray:
    """The share of a room's views that may be drawn."""
    order = np.random.default_rng([seed, index]).permutation(count)
    return np.sort(order[: max(1, round(fraction * count))])


def drawn_views(allowed: np.ndarray, row: int, epoch: int, number: int, seed: int) -> np.ndarray:
    generator = np.random.default_rng([seed, row, epoch])
    if len(allowed) >= number:
        return generator.choice(allowed, number, replace=False)
    return np.resize(generator.permutation(allowed), number)


def turn_about_up(quarter: int) -> np.ndarray:
    """(4, 4) rotation by quarter * 90 degrees about +y, exact."""
    cosine, sine = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter]
    turn = np.eye(4, dtype=np.float32)
    turn[0, 0] = turn[2, 2] = cosine
    turn[0, 2], turn[2, 0] = sine, -sine
    return turn


def batch_room_by_room(
    rooms: list[RoomViews],
    draws: list[tuple[int, int]],
    views_per_room: int,
    rotations: int = 1,
    view_fraction: float = 1.0,
    mask_step: int | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """The arrays of a batch by name; each draw is (row, epoch)."""
    of_rows = [rooms[row // rotations] for row, _ in draws]
    objects = max(len(room.object_class) for room in of_rows)
    shape = (len(draws), views_per_room)
    batch: dict[str, Any] = {
        "room_index": np.array([row for row, _ in draws]),
        "object_class": np.zeros((len(draws), objects), dtype=np.int64),
        "is_object": np.zeros((len(draws), objects), dtype=bool),
        "world_to_camera": np.empty((*shape, 4, 4), dtype=np.float32),
        "intrinsics": np.empty((*shape, 3, 3), dtype=np.float32),
        "boxes": np.zeros((*shape, objects, 4), dtype=np.float32),
        "visible": np.zeros((*shape, objects), dtype=bool),
        "sides_clear": np.zeros((*shape, objects, 4), dtype=bool),
    }
    images = []
    for slot, ((row, epoch), room) in enumerate(zip(draws, of_rows, strict=True)):
        index, quarter = divmod(row, rotations)
        allowed = allowed_views(index, len(room.visible), view_fraction, seed)
        views = drawn_views(allowed, row, epoch, views_per_room, seed)
        count = len(room.object_class)
        batch["object_class"][slot, :count] = room.object_class
        batch["is_object"][slot, :count] = True
        batch["boxes"][slot, :, :count] = room.boxes[views]
        batch["visible"][slot, :, :count] = room.visible[views]
        batch["sides_clear"][slot, :, :count] = room.sides_clear[views]
        batch["world_to_camera"][slot] = room.world_to_camera[views] @ turn_about_up(quarter).T
        batch["intrinsics"][slot] = room.intrinsics[views]
        if mask_step is not None:
            half = mask_step // 2
            assert room.instance_ids is not None
            images.append(room.instance_ids[views, half::mask_step, half::mask_step])
    if mask_step is not None:
        batch["instance_ids"] = np.stack(images)
    return batch
