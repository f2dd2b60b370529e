"""Draws views and floor plans of rooms in shards, and sheets of them with a legend."""

import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely
from PIL import Image, ImageDraw

from data_prep.inspection.agreement import Hull, project_edges
from sceneprior.core.boxes import BOX_EDGES, box_corners
from sceneprior.core.cameras import camera_centers
from sceneprior.core.classes import class_colors, label_set
from sceneprior.core.errors import InputError
from sceneprior.core.observations import RoomGroundTruth, RoomViews
from sceneprior.core.shards import Shard, list_shards, splits_of
from sceneprior.core.wall_lines import find_walls, seen_floor
from sceneprior.render.appearance import contact_sheet, paint_ids

BACKGROUND = (246, 246, 246)
GRID = (206, 206, 206)
OUTLINE = (120, 120, 120)
FLOOR, WALL, DOOR = (226, 220, 204), (90, 70, 50), (230, 140, 20)
AXES = {"x": (205, 30, 30), "y": (20, 140, 40), "z": (30, 60, 210)}
_AXIS_M, _BAR_M = 0.5, 0.3
_GRID_M, _LARGEST_GRID_M = 1.0, 15.0
_TILE = (480, 360)
_GAP_PX, _LINE_PX = 8, 15

Color = tuple[int, int, int]


def draw_sheet(folder: Path, room_id: str | None, pictures: int) -> Image.Image:
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
                tiles.append(np.asarray(draw_plan(shard, name)))
            captions.append(f"{short}  view {view}")
            tiles.append(np.asarray(draw_view(shard, name, view)))
    sheet = contact_sheet(tiles, min(4, len(tiles)), captions, _GAP_PX)
    lines = textwrap.wrap(legend(wires, floors), max(40, sheet.shape[1] // 6))
    borders = ((_LINE_PX * len(lines), _GAP_PX), (0, 0), (0, 0))
    picture = Image.fromarray(np.pad(sheet, borders, constant_values=255))
    draw = ImageDraw.Draw(picture)
    for i, line in enumerate(lines):
        draw.text((_GAP_PX, 4 + _LINE_PX * i), line, fill="black", font_size=11)
    return picture


def legend(wires: bool, floors: bool) -> str:
    """Explain a sheet with or without 3D boxes of the ground truth, and with or without a plan of
    what masks of floor, walls and doors show."""
    masks = (
        "Filled: instance masks in class colours. Coloured frames: their 2D boxes, with the "
        "object's number, the same in all views. "
    )
    boxes = "Black wires: 3D boxes of the ground truth, with a bar ahead of the piece's front. "
    grid = "Grid: the floor y = 0, metres, with the room's axes x, y, z."
    plan = (
        " From above, found in masks of floor, walls and doors: the floor that some view shows "
        "(filled), walls (brown) and doors (orange)."
    )
    return masks + boxes * wires + grid + plan * floors


def choose_views(folder: Path, room_id: str | None, pictures: int) -> list[tuple[Path, str, int]]:
    """Shard, room and number of views spread evenly over a folder, or over one room."""
    rooms = []
    for path in (path for split in splits_of(folder) for path in list_shards(folder, split)):
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


def draw_view(
    shard: Shard, room_id: str, view: int, boxes_3d: bool = True, width_px: int = _TILE[0]
) -> Image.Image:
    """Draw one view: masks in class colours and 2D boxes; ground-truth 3D boxes as black wires.

    A bar in front of each wire box marks the piece's front. The floor (y = 0) is a metric grid
    with the axes of the room frame, so that a wrong floor, axis or unit is noticed even without 3D
    ground truth. Line widths and font sizes do not depend on `width_px`.
    """
    room, truth, names, colors = _read(shard, room_id)
    truth = truth if boxes_3d else None
    height, width = room.image_size
    zoom = width_px / width
    size = (width_px, max(1, round(height * zoom)))
    picture = Image.new("RGB", size, BACKGROUND)
    draw = ImageDraw.Draw(picture)
    intrinsics = np.diag([zoom, zoom, 1.0]) @ room.intrinsics[view].astype(np.float64)

    def project(points_m: np.ndarray, edges: Sequence[tuple[int, int]]) -> list[list[float]]:
        hull = Hull(np.asarray(points_m), np.array(edges))
        lines = project_edges(hull, room.world_to_camera[view], intrinsics).round(6)
        return lines[~np.isnan(lines[:, 0])].tolist()

    def wires(
        points_m: np.ndarray, edges: Sequence[tuple[int, int]], color: Color, width: int = 1
    ) -> None:
        for line in project(points_m, edges):
            draw.line(line, fill=color, width=width)

    grid = _grid(*_floor_bounds(room, truth)).reshape(-1, 3)
    wires(grid, [(k, k + 1) for k in range(0, len(grid), 2)], GRID)
    if truth is not None and (corners := len(truth.floor_m)) > 2:
        outline = np.insert(truth.floor_m.astype(np.float64), 1, 0.0, axis=1)
        wires(outline, [(k, (k + 1) % corners) for k in range(corners)], OUTLINE, 2)
    ids = Image.fromarray(shard.read_instance_ids(room_id, [view])[0].astype(np.int32))
    large = np.asarray(ids.resize(size, Image.Resampling.NEAREST))
    palette = colors[room.object_class]
    # Colours are mixed with white, so that wires and names stand out.
    pale = (palette.astype(np.int32) + 255) // 2
    painted = Image.fromarray(paint_ids(large, pale, BACKGROUND))
    picture.paste(painted, mask=Image.fromarray(large > 0))
    for name, end in zip(AXES, np.eye(3) * _AXIS_M, strict=True):
        for line in project(np.stack([np.zeros(3), end]), [(0, 1)]):
            draw.line(line, fill=AXES[name], width=2)
            draw.text((line[2], line[3]), name, fill=AXES[name], font_size=12, anchor="mm")
    seen = np.flatnonzero(room.visible[view]).tolist()
    for k in [] if truth is None else seen:
        assert truth is not None
        corners_m = box_corners(truth.centers_m[k], truth.sizes_m[k])
        wires(corners_m, BOX_EDGES, (255, 255, 255), 3)
        wires(corners_m, BOX_EDGES, (0, 0, 0))
        if truth.model_ids[k]:  # the front is unknown without a mesh
            wires(_front(truth, k), [(0, 1)], (0, 0, 0), 3)
    for k in seen:
        x1, y1, x2, y2 = (room.boxes[view, k] * np.array([*size, *size])).tolist()
        dark = _dark(palette[k])
        draw.rectangle((x1, y1, max(x2 - 1, x1), max(y2 - 1, y1)), outline=dark, width=2)
        _tag(draw, (x1 + 2, y1 + 2), f"{names[int(room.object_class[k])]} {k + 1}", dark)
    return picture


def draw_plan(shard: Shard, room_id: str) -> Image.Image:
    """Draw the room from above (+x right, +z down): floor, walls, boxes, fronts, cameras."""
    has_stuff = shard.has_stuff(room_id)
    room, truth, names, colors = _read(shard, room_id, images=has_stuff)
    low, high = _floor_bounds(room, truth)
    zoom = (_TILE / (high - low + 0.8)).min()
    middle = (low + high) / 2

    def at(x: float, z: float) -> tuple[float, float]:
        return (_TILE[0] / 2 + zoom * (x - middle[0]), _TILE[1] / 2 + zoom * (z - middle[1]))

    picture = Image.new("RGB", _TILE, BACKGROUND)
    draw = ImageDraw.Draw(picture)
    if has_stuff:
        for part in shapely.get_parts(seen_floor(room)):
            draw.polygon([at(*point) for point in part.exterior.coords], fill=FLOOR)
            for hole in part.interiors:
                draw.polygon([at(*point) for point in hole.coords], fill=BACKGROUND)
    for (x1, _, z1), (x2, _, z2) in _grid(low, high).tolist():
        draw.line((*at(x1, z1), *at(x2, z2)), fill=GRID)
    if truth is not None:
        if len(truth.floor_m) > 2:
            draw.polygon([at(*point) for point in truth.floor_m.tolist()], outline=OUTLINE, width=2)
        for k in np.argsort(truth.centers_m[:, 1] + truth.sizes_m[:, 1] / 2, kind="stable"):
            (x, _, z), half = truth.centers_m[k].tolist(), truth.sizes_m[k] / 2
            color = colors[truth.object_class[k]]
            corner = at(x - half[0], z - half[2])
            draw.rectangle(
                (*corner, *at(x + half[0], z + half[2])), tuple(color.tolist()), outline="black"
            )
            if truth.model_ids[k]:
                start, end = _front(truth, k)
                draw.line((*at(start[0], start[2]), *at(end[0], end[2])), fill="black", width=3)
            label = names[int(truth.object_class[k])]
            _tag(draw, (corner[0] + 2, corner[1] + 2), label, _dark(color))
    if has_stuff:
        walls, doors = find_walls(room)
        ends = [(wall.start_m, wall.end_m, WALL) for wall in walls]
        for start, end, color in ends + [(door.start_m, door.end_m, DOOR) for door in doors]:
            draw.line((*at(*start), *at(*end)), fill=color, width=4)
    for matrix in room.world_to_camera.astype(np.float64):
        eye = camera_centers(matrix)
        u, v = at(eye[0], eye[2])
        draw.ellipse((u - 2, v - 2, u + 2, v + 2), fill=OUTLINE)
        ahead = eye + 0.3 * matrix[2, :3]
        draw.line((u, v, *at(ahead[0], ahead[2])), fill=OUTLINE)
    for name, (x, z) in {"x": (_AXIS_M, 0.0), "z": (0.0, _AXIS_M)}.items():
        draw.line((*at(0, 0), *at(x, z)), fill=AXES[name], width=2)
        draw.text(at(1.2 * x, 1.2 * z), name, fill=AXES[name], font_size=12, anchor="mm")
    return picture


def _read(
    shard: Shard, room_id: str, images: bool = False
) -> tuple[RoomViews, RoomGroundTruth | None, tuple[str, ...], np.ndarray]:
    """A room's views and ground truth, and the names and colours of the classes."""
    truth = shard.read_ground_truth(room_id) if shard.has_ground_truth(room_id) else None
    names = label_set(shard.label_set)
    return shard.read_room(room_id, images=images), truth, names, class_colors(len(names))


def _floor_bounds(room: RoomViews, truth: RoomGroundTruth | None) -> tuple[np.ndarray, np.ndarray]:
    """Bounds in x and z of the floor and the objects, or of the cameras without ground truth."""
    points = np.zeros((0, 2))
    if truth is not None:
        half = truth.sizes_m[:, (0, 2)] / 2
        middle = truth.centers_m[:, (0, 2)]
        points = np.concatenate([truth.floor_m, middle - half, middle + half])
    if not len(points):
        points = camera_centers(room.world_to_camera)[:, (0, 2)]
        points = np.concatenate([points - 1, points + 1])
    # The bounds are clipped, because a unit wrong by a factor of 1000 would need a million lines.
    return (
        np.clip(points.min(axis=0), -_LARGEST_GRID_M, -_GRID_M).astype(np.float64),
        np.clip(points.max(axis=0), _GRID_M, _LARGEST_GRID_M).astype(np.float64),
    )


def _grid(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Metric grid on the floor, (lines, 2, 3), in segments of 1 m, so that clipping one loses
    little."""
    (x1, z1), (x2, z2) = np.floor(low).astype(int).tolist(), np.ceil(high).astype(int).tolist()
    lines = [((x, 0, z), (x, 0, z + 1)) for x in range(x1, x2 + 1) for z in range(z1, z2)]
    lines += [((x, 0, z), (x + 1, 0, z)) for z in range(z1, z2 + 1) for x in range(x1, x2)]
    return np.array(lines, dtype=np.float64)


def _front(truth: RoomGroundTruth, k: int) -> np.ndarray:
    """Ends, (2, 3), of a bar on the floor, 0.3 m long, from the centre of the piece's front."""
    yaw, half = float(truth.yaw_rad[k]), truth.sizes_m[k].astype(np.float64) / 2
    ahead = np.array([np.sin(yaw), 0.0, np.cos(yaw)])
    reach = min(half[0] / max(abs(ahead[0]), 1e-9), half[2] / max(abs(ahead[2]), 1e-9))
    foot = truth.centers_m[k].astype(np.float64) - (0, half[1], 0)
    return np.stack([foot + reach * ahead, foot + (reach + _BAR_M) * ahead])


def _tag(draw: ImageDraw.ImageDraw, place: tuple[float, float], text: str, color: Color) -> None:
    left, top, right, bottom = draw.textbbox(place, text, font_size=11)
    draw.rectangle((left - 1, top - 1, right + 1, bottom + 1), fill=color)
    draw.text(place, text, fill="white", font_size=11)


def _dark(color: np.ndarray) -> Color:
    red, green, blue = (int(channel) * 11 // 20 for channel in color)
    return (red, green, blue)
