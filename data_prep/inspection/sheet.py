"""Draws sheets of views and floor plans, with a legend."""

import textwrap
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from data_prep.engine.source import SPLITS
from data_prep.inspection.pictures import draw_plan, draw_view, font_of
from sceneprior.core.errors import InputError
from sceneprior.core.shards import Shard, list_shards
from sceneprior.render.pictures import contact_sheet

_TILE = (480, 360)
_GAP_PX, _LINE_PX = 8, 15


def draw_sheet(folder: Path, room_id: str | None = None, pictures: int = 24) -> Image.Image:
    """Draw views of a folder, or of one room and its plan, on one sheet; see `legend`."""
    captions: list[str] = []
    tiles: list[np.ndarray] = []
    wires = floors = False
    for path, name, view in choose_views(folder, room_id, pictures):
        short = name if len(name) <= 56 else f"{name[:8]}...{name[-45:]}"
        with Shard(path) as shard:
            wires |= shard.has_ground_truth(name)
            if room_id is not None and not tiles:
                floors = shard.has_stuff(name)
                captions.append(f"{short}  from above")
                tiles.append(np.asarray(draw_plan(shard, name, *_TILE)))
            captions.append(f"{short}  view {view}")
            tiles.append(np.asarray(draw_view(shard, name, view, True, _TILE[0])))
    sheet = contact_sheet(tiles, min(4, len(tiles)), captions, _GAP_PX)
    lines = textwrap.wrap(legend(wires, floors), max(40, sheet.shape[1] // 6))
    borders = ((_LINE_PX * len(lines), _GAP_PX), (0, 0), (0, 0))
    picture = Image.fromarray(np.pad(sheet, borders, constant_values=255))
    draw = ImageDraw.Draw(picture)
    for i, line in enumerate(lines):
        draw.text((_GAP_PX, 4 + _LINE_PX * i), line, fill="black", font=font_of(11))
    return picture


def legend(wires: bool, floors: bool) -> str:
    """Explain a sheet with or without 3D boxes of the ground truth, and with or without a plan of
    what masks of floor, walls and doors show."""
    parts = [
        "Filled: instance masks in class colours. Coloured frames: their 2D boxes, with the "
        "object's number, the same in all views.",
        "Grid: the floor y = 0, metres, with the room's axes x, y, z.",
    ]
    if wires:
        parts.insert(
            1, "Black wires: 3D boxes of the ground truth, with a bar ahead of the piece's front."
        )
    if floors:
        parts.append(
            "From above, found in masks of floor, walls and doors: the floor that some view shows "
            "(filled), walls (brown) and doors (orange)."
        )
    return " ".join(parts)


def choose_views(folder: Path, room_id: str | None, pictures: int) -> list[tuple[Path, str, int]]:
    """Shard, room and number of views spread evenly over a folder, or over one room."""
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
        # Views are evenly spaced, because a recording's views are in temporal order.
        places = np.unique(np.linspace(0, views, min(share, views), endpoint=False).astype(int))
        chosen += [(path, name, int(view)) for view in places]
    return chosen
