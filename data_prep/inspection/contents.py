"""Contents of a folder of shards: counts, a room's objects, and a sheet of pictures."""

import textwrap
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from data_prep.engine.source import SPLITS
from data_prep.inspection.pictures import draw_plan, draw_view
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.shards import Shard, iterate_rooms, list_shards, read_index
from sceneprior.render.pictures import contact_sheet

LEGEND = (
    "Filled: instance masks in class colours. Coloured frames: their 2D boxes. Black wires: 3D "
    "boxes of the ground truth, with a bar ahead of the piece's front. Grid: the floor y = 0, "
    "metres, with the room's axes x, y, z."
)
_TILE = (480, 360)
_GAP_PX, _LINE_PX = 8, 15


def count_shards(folder: Path) -> dict[str, dict[str, Any]]:
    """Count the contents of each split.

    The counts are rooms, views, objects, seen (visible objects per view), with_truth (rooms with 3D
    ground truth), image_sizes (rooms per size such as "480 x 360"), and classes (objects per
    class).
    """
    names = label_set(read_index(folder)["label_set"])
    table: dict[str, dict[str, Any]] = {}
    for split in SPLITS:
        if not any((Path(folder) / split).glob("*.h5")):
            continue  # the folder was made with --only
        rooms, known = [], 0
        for shard, room_id in iterate_rooms(folder, split):
            rooms.append(shard.read_room(room_id))
            known += shard.has_ground_truth(room_id)
        classes = Counter(names[index] for room in rooms for index in room.object_class)
        views = sum(len(room.visible) for room in rooms)
        sizes = Counter("{1} x {0}".format(*room.image_size) for room in rooms)
        table[split] = {
            "rooms": len(rooms),
            "views": views,
            "objects": sum(len(room.object_class) for room in rooms),
            "seen": sum(int(room.visible.sum()) for room in rooms) / max(views, 1),
            "with_truth": known,
            "image_sizes": dict(sizes.most_common()),
            "classes": dict(classes.most_common()),
        }
    return table


def describe_room(folder: Path, room_id: str) -> list[dict[str, Any]]:
    """Describe the objects of a room.

    An object has class, views (number that show it), share (mean area of its 2D box relative to
    the image), and center_m and size_m, which are None without 3D ground truth.
    """
    ((path, _, _),) = _choose(folder, room_id, 1)
    with Shard(path) as shard:
        views = shard.read_room(room_id)
        truth = shard.read_ground_truth(room_id) if shard.has_ground_truth(room_id) else None
        names = label_set(shard.label_set)
    classes = views.object_class if truth is None else truth.object_class
    rows = []
    for k, index in enumerate(classes):
        seen = views.visible[:, k] if k < len(views.object_class) else np.zeros(0, dtype=bool)
        boxes = views.boxes[seen, k] if seen.any() else np.zeros((1, 4), dtype=np.float32)
        rows.append(
            {
                "class": names[int(index)],
                "views": int(seen.sum()),
                "share": float((boxes[:, 2:] - boxes[:, :2]).prod(axis=1).mean()),
                "center_m": None if truth is None else truth.centers_m[k].tolist(),
                "size_m": None if truth is None else truth.sizes_m[k].tolist(),
            }
        )
    return rows


def draw_sheet(
    folder: Path, room_id: str | None = None, pictures: int = 24, boxes_3d: bool = True
) -> Image.Image:
    """Draw views of a folder, or of one room and its plan, on one sheet; see `LEGEND`."""
    captions: list[str] = []
    tiles: list[np.ndarray] = []
    for path, name, view in _choose(folder, room_id, pictures):
        short = name if len(name) <= 56 else f"{name[:8]}...{name[-45:]}"
        with Shard(path) as shard:
            if room_id is not None and not tiles:
                captions.append(f"{short}  from above")
                tiles.append(np.asarray(draw_plan(shard, name, *_TILE)))
            captions.append(f"{short}  view {view}")
            tiles.append(np.asarray(draw_view(shard, name, view, boxes_3d, _TILE[0])))
    sheet = contact_sheet(tiles, min(4, len(tiles)), captions, _GAP_PX)
    legend = textwrap.wrap(LEGEND, max(40, sheet.shape[1] // 6))
    borders = ((_LINE_PX * len(legend), _GAP_PX), (0, 0), (0, 0))
    picture = Image.fromarray(np.pad(sheet, borders, constant_values=255))
    draw = ImageDraw.Draw(picture)
    for i, line in enumerate(legend):
        place, font = (_GAP_PX, 4 + _LINE_PX * i), ImageFont.load_default(size=11)
        draw.text(place, line, fill="black", font=font)
    return picture


def _choose(folder: Path, room_id: str | None, pictures: int) -> list[tuple[Path, str, int]]:
    splits = [split for split in SPLITS if any((Path(folder) / split).glob("*.h5"))]
    rooms = []
    for path in [path for split in splits for path in list_shards(folder, split)]:
        with Shard(path) as shard:
            rooms += [(path, name) for name in shard.room_ids]
    if not rooms:
        list_shards(folder, "train")  # raises the error that explains why
    if room_id is not None:
        rooms = [room for room in rooms if room[1] == room_id]
        if not rooms:
            raise InputError(f"{folder} has no room '{room_id}'; its report.csv lists the rooms.")
    if len(rooms) > pictures:
        rooms = [rooms[i * len(rooms) // pictures] for i in range(pictures)]
    chosen = []
    for i, (path, name) in enumerate(rooms):
        share = pictures // len(rooms) + (i < pictures % len(rooms))
        with Shard(path) as shard:
            views = len(shard.read_room(name).visible)
        # Evenly spaced, because the views of a recording are in temporal order.
        places = np.unique(np.linspace(0, views, min(share, views), endpoint=False).astype(int))
        chosen += [(path, name, int(view)) for view in places]
    return chosen
