"""A folder of shards in, a table and a contact sheet out: to see with one's own eyes."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from sceneprior.classes import class_colors, label_set
from sceneprior.errors import InputError
from sceneprior.shards import Shard, iterate_rooms, list_shards, read_index

SPLITS = ("train", "test")
_THUMBNAIL = (360, 270)
# Corners of a box in binary order (x, y, z); an edge joins corners that differ in one of them.
_EDGES = [(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit]


def count_shards(folder: Path) -> dict[str, dict[str, Any]]:
    """Per split: rooms, views, objects, seen (visible objects a view), classes (a histogram).

    Raises:
        ShardError: the folder is not a finished folder of shards, or a shard is damaged.
    """
    names = label_set(read_index(folder)["label_set"])
    table: dict[str, dict[str, Any]] = {}
    for split in SPLITS:
        if not any((Path(folder) / split).glob("*.h5")):
            continue  # made with --only
        rooms = [shard.read_room(room_id) for shard, room_id in iterate_rooms(folder, split)]
        classes = Counter(names[index] for room in rooms for index in room.object_class)
        views = sum(len(room.visible) for room in rooms)
        table[split] = {
            "rooms": len(rooms),
            "views": views,
            "objects": sum(len(room.object_class) for room in rooms),
            "seen": sum(int(room.visible.sum()) for room in rooms) / max(views, 1),
            "classes": dict(classes.most_common()),
        }
    return table


def contact_sheet(
    folder: Path, room_id: str | None = None, pictures: int = 24, boxes_3d: bool = False
) -> Image.Image:
    """Instance masks in class colours, 2D boxes round them, on one sheet.

    Args:
        folder: Shards.
        room_id: Views of this room; None: some views of rooms throughout the folder.
        pictures: How many.
        boxes_3d: Also the ground truth's 3D boxes, projected into the view, in thin black.

    Raises:
        InputError: no room has this id.
    """
    chosen = _choose(folder, room_id, pictures)
    columns = min(4, len(chosen))
    rows = -(-len(chosen) // columns)
    gap, caption = 6, 16
    width, height = _THUMBNAIL
    sheet = Image.new(
        "RGB", (columns * (width + gap) + gap, rows * (height + caption + gap) + gap), "white"
    )
    draw = ImageDraw.Draw(sheet)
    for i, (path, name, view) in enumerate(chosen):
        x = gap + (i % columns) * (width + gap)
        y = gap + (i // columns) * (height + caption + gap)
        with Shard(path) as shard:
            picture = draw_view(shard, name, view, boxes_3d)
        sheet.paste(picture.resize(_THUMBNAIL, Image.Resampling.LANCZOS), (x, y + caption))
        draw.text((x, y + 2), f"{name[-48:]}  view {view}", fill="black")
    return sheet


def _choose(folder: Path, room_id: str | None, pictures: int) -> list[tuple[Path, str, int]]:
    splits = [split for split in SPLITS if any((Path(folder) / split).glob("*.h5"))]
    rooms = []
    for path in [path for split in splits for path in list_shards(folder, split)]:
        with Shard(path) as shard:
            rooms += [(path, name) for name in shard.room_ids]
    if not rooms:
        list_shards(folder, "train")  # says what is wrong
    if room_id is not None:
        rooms = [room for room in rooms if room[1] == room_id]
        if not rooms:
            raise InputError(f"{folder} has no room '{room_id}'; its report.csv lists the rooms.")
    chosen = []
    for i in range(pictures):
        path, name = rooms[i * len(rooms) // pictures if len(rooms) > pictures else i % len(rooms)]
        with Shard(path) as shard:
            views = len(shard.read_room(name).visible)
        turn = i // len(rooms)
        if turn < views:
            each = max(1, views // max(1, pictures // len(rooms)))
            chosen.append((path, name, (turn * each) % views))
    return sorted(chosen, key=lambda item: (rooms.index(item[:2]), item[2]))


def draw_view(shard: Shard, room_id: str, view: int, boxes_3d: bool = False) -> Image.Image:
    """One view as a picture: each object's mask in its class colour, its box, its class."""
    names = label_set(shard.label_set)
    room = shard.read_room(room_id)
    ids = shard.read_instance_ids(room_id, [view])[0]
    colors = class_colors(len(names))[room.object_class]
    image = np.concatenate([[(245, 245, 245)], colors]).astype(np.uint8)[ids]
    # A dark rim parts two neighbours of one class.
    rim = np.zeros(ids.shape, dtype=bool)
    rim[:, 1:] |= ids[:, 1:] != ids[:, :-1]
    rim[1:] |= ids[1:] != ids[:-1]
    image[rim] = image[rim] // 2
    picture = Image.fromarray(image)
    draw = ImageDraw.Draw(picture)
    height, width = room.image_size
    for k in np.flatnonzero(room.visible[view]):
        x1, y1, x2, y2 = room.boxes[view, k] * (width, height, width, height)
        draw.rectangle((x1, y1, x2 - 1, y2 - 1), outline=tuple(int(c) // 2 for c in colors[k]))
        draw.text((x1 + 3, y1 + 2), names[room.object_class[k]], fill="black")
    if boxes_3d:
        truth = shard.read_ground_truth(room_id)
        for k in np.flatnonzero(room.visible[view]):
            corners = box_corners(truth.centers_m[k], truth.sizes_m[k])
            points = (
                corners @ room.world_to_camera[view, :3, :3].T + room.world_to_camera[view, :3, 3]
            )
            for a, b in _EDGES:
                _draw_edge(draw, points[a], points[b], room.intrinsics[view])
    return picture


def box_corners(center_m: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """(8, 3) corners of an axis-aligned box; bits 0, 1, 2 of the row choose x, y, z."""
    bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
    return np.asarray(center_m) + (bits - 0.5) * np.asarray(size_m)


def _draw_edge(draw: ImageDraw.ImageDraw, a: np.ndarray, b: np.ndarray, K: np.ndarray) -> None:
    near = 0.05
    if a[2] < near and b[2] < near:
        return
    if a[2] < near or b[2] < near:  # cut the edge at the camera
        behind, ahead = (a, b) if a[2] < near else (b, a)
        a, b = ahead, behind + (ahead - behind) * (near - behind[2]) / (ahead[2] - behind[2])
    (u1, v1, _), (u2, v2, _) = K @ (a / a[2]), K @ (b / b[2])
    draw.line((u1, v1, u2, v2), fill="black")
