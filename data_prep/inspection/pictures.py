"""Draws a view or the floor plan of a room in a shard."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from PIL import Image, ImageDraw, ImageFont

from data_prep.inspection.agreement import NEAR_M
from sceneprior.core.boxes import BOX_EDGES, box_corners
from sceneprior.core.cameras import camera_centers, to_camera, to_pixels
from sceneprior.core.classes import class_colors, label_set
from sceneprior.core.observations import RoomGroundTruth, RoomViews
from sceneprior.core.shards import Shard
from sceneprior.core.wall_lines import find_walls, seen_floor
from sceneprior.render.pictures import paint_ids

BACKGROUND = (246, 246, 246)
GRID = (206, 206, 206)
OUTLINE = (120, 120, 120)
FLOOR, WALL, DOOR = (226, 220, 204), (90, 70, 50), (230, 140, 20)
AXES = {"x": (205, 30, 30), "y": (20, 140, 40), "z": (30, 60, 210)}
_AXIS_M = 0.5
_GRID_M = 1.0
_BAR_M = 0.3
_LARGEST_GRID_M = 15.0


Color = tuple[int, int, int]
Segment = tuple[float, float, float, float]


def draw_view(
    shard: Shard, room_id: str, view: int, boxes_3d: bool = True, width_px: int = 480
) -> Image.Image:
    """Draw one view: masks in class colours and 2D boxes; ground-truth 3D boxes as black wires.

    A bar in front of each wire box marks the piece's front. The floor (y = 0) is a metric grid
    with the axes of the room frame, so that a wrong floor, axis or unit is noticed even without 3D
    ground truth. Line widths and font sizes do not depend on `width_px`.
    """
    room = shard.read_room(room_id)
    truth = _truth(shard, room_id) if boxes_3d else None
    names = label_set(shard.label_set)
    height, width = room.image_size
    zoom = width_px / width
    size = (width_px, max(1, round(height * zoom)))
    picture = Image.new("RGB", size, BACKGROUND)
    draw = ImageDraw.Draw(picture)
    intrinsics = np.diag([zoom, zoom, 1.0]) @ room.intrinsics[view].astype(np.float64)
    wires = _Wires(draw, room.world_to_camera[view], intrinsics)
    wires.floor(room, truth)
    ids = Image.fromarray(shard.read_instance_ids(room_id, [view])[0].astype(np.int32))
    large = np.asarray(ids.resize(size, Image.Resampling.NEAREST))
    palette = class_colors(len(names))[room.object_class]
    # Colours are mixed with white, so that wires and names stand out.
    pale = (palette.astype(np.int32) + 255) // 2
    painted = Image.fromarray(paint_ids(large, pale, BACKGROUND))
    picture.paste(painted, mask=Image.fromarray(large > 0))
    for name, end in zip(AXES, np.eye(3) * _AXIS_M, strict=True):
        ends = np.stack([np.zeros(3), end])
        wires.line(ends, AXES[name], 2)
        for line in wires.pixels(ends, [(0, 1)]):
            draw.text(line[2:], name, fill=AXES[name], font=font_of(12), anchor="mm")
    seen = np.flatnonzero(room.visible[view])
    if truth is not None:
        for number in seen.tolist():
            wires.box(truth, number)
    for k in seen:
        x1, y1, x2, y2 = (room.boxes[view, k] * np.array([*size, *size])).tolist()
        dark = _dark(palette[k])
        draw.rectangle((x1, y1, max(x2 - 1, x1), max(y2 - 1, y1)), outline=dark, width=2)
        _tag(draw, (x1 + 2, y1 + 2), f"{names[int(room.object_class[k])]} {k + 1}", dark)
    return picture


def wire_pixels(
    points_m: np.ndarray,
    edges: Iterable[tuple[int, int]],
    world_to_camera: np.ndarray,
    intrinsics: np.ndarray,
) -> list[Segment]:
    """Project edges, pairs of rows of points, to lines in the image, clipped at the near plane.

    Returns u1, v1, u2, v2 of every edge that lies at least partly beyond the near plane.

    Example: a line that begins 1 m behind the camera is visible from the near plane on.

        >>> line = np.array([[0.0, 0, -1], [0.2, 0, 2]])
        >>> wire_pixels(line, [(0, 1)], np.eye(4), np.diag([10.0, 10, 1]))
        [(14.0, 0.0, 1.0, 0.0)]
    """
    ends = to_camera(points_m.astype(np.float64), world_to_camera)[np.array(edges)]
    ends = ends[ends[..., 2].max(axis=1) >= NEAR_M]
    low, high = ends[..., 2].min(axis=1), ends[..., 2].max(axis=1)
    # The nearer end moves along the line to the near plane.
    share = np.where(low < NEAR_M, (NEAR_M - low) / np.where(high > low, high - low, 1), 0.0)
    nearer = ends[..., 2] < NEAR_M
    ends += nearer[..., None] * share[:, None, None] * (ends[:, ::-1] - ends)
    lines = to_pixels(ends.reshape(-1, 3), intrinsics.astype(np.float64)).round(6).reshape(-1, 4)
    return [tuple(line) for line in lines.tolist()]


def draw_plan(shard: Shard, room_id: str, width_px: int = 480, height_px: int = 360) -> Image.Image:
    """Draw the room from above (+x right, +z down): floor, walls, boxes, fronts, cameras."""
    has_stuff = shard.has_stuff(room_id)
    room, truth = shard.read_room(room_id, images=has_stuff), _truth(shard, room_id)
    names = label_set(shard.label_set)
    colors = class_colors(len(names))
    low, high = _floor_bounds(room, truth)
    margin = 0.4
    zoom = min(
        width_px / (high[0] - low[0] + 2 * margin), height_px / (high[1] - low[1] + 2 * margin)
    )
    middle = (low + high) / 2

    def at(x: float, z: float) -> tuple[float, float]:
        return (width_px / 2 + zoom * (x - middle[0]), height_px / 2 + zoom * (z - middle[1]))

    picture = Image.new("RGB", (width_px, height_px), BACKGROUND)
    draw = ImageDraw.Draw(picture)
    if has_stuff:
        for part in shapely.get_parts(seen_floor(room)):
            draw.polygon([at(*point) for point in part.exterior.coords], fill=FLOOR)
            for hole in part.interiors:
                draw.polygon([at(*point) for point in hole.coords], fill=BACKGROUND)
    for (x1, _, z1), (x2, _, z2) in _grid(low, high):
        draw.line((*at(x1, z1), *at(x2, z2)), fill=GRID)
    if truth is not None:
        if len(truth.floor_m) > 2:
            draw.polygon([at(*point) for point in truth.floor_m.tolist()], outline=OUTLINE, width=2)
        for k in np.argsort(truth.centers_m[:, 1] + truth.sizes_m[:, 1] / 2, kind="stable"):
            (x, _, z), half = truth.centers_m[k].tolist(), truth.sizes_m[k] / 2
            color = tuple(int(channel) for channel in colors[truth.object_class[k]])
            corners = (*at(x - half[0], z - half[2]), *at(x + half[0], z + half[2]))
            draw.rectangle(corners, fill=color, outline="black")
            if truth.model_ids[k]:
                start, end = _front(truth, k)
                draw.line((*at(start[0], start[2]), *at(end[0], end[2])), fill="black", width=3)
            label = names[int(truth.object_class[k])]
            _tag(
                draw, (corners[0] + 2, corners[1] + 2), label, _dark(colors[truth.object_class[k]])
            )
    if has_stuff:
        walls, doors = find_walls(room)
        for lines, color in ((walls, WALL), (doors, DOOR)):
            for line in lines:
                draw.line((*at(*line.start_m), *at(*line.end_m)), fill=color, width=4)
    for matrix in room.world_to_camera.astype(np.float64):
        eye = camera_centers(matrix)
        u, v = at(eye[0], eye[2])
        draw.ellipse((u - 2, v - 2, u + 2, v + 2), fill=OUTLINE)
        ahead = eye + 0.3 * matrix[2, :3]
        draw.line((u, v, *at(ahead[0], ahead[2])), fill=OUTLINE)
    for name, (x, z) in {"x": (_AXIS_M, 0.0), "z": (0.0, _AXIS_M)}.items():
        draw.line((*at(0, 0), *at(x, z)), fill=AXES[name], width=2)
        draw.text(at(1.2 * x, 1.2 * z), name, fill=AXES[name], font=font_of(12), anchor="mm")
    return picture


@dataclass(frozen=True)
class _Wires:
    """Draws lines of the room into one view."""

    draw: ImageDraw.ImageDraw
    world_to_camera: np.ndarray
    intrinsics: np.ndarray

    def pixels(self, points_m: np.ndarray, edges: Iterable[tuple[int, int]]) -> list[Segment]:
        return wire_pixels(points_m, edges, self.world_to_camera, self.intrinsics)

    def line(self, ends_m: np.ndarray, color: Color, width: int = 1) -> None:
        if to_camera(ends_m, self.world_to_camera)[:, 2].max() > 0:
            for line in self.pixels(ends_m, [(0, 1)]):
                self.draw.line(line, fill=color, width=width)

    def floor(self, room: RoomViews, truth: RoomGroundTruth | None) -> None:
        for ends in _grid(*_floor_bounds(room, truth)):
            self.line(np.asarray(ends), GRID)
        if truth is not None and len(truth.floor_m) > 2:
            outline = np.insert(truth.floor_m.astype(np.float64), 1, 0.0, axis=1)
            for first, second in zip(outline, np.roll(outline, -1, axis=0), strict=True):
                self.line(np.stack([first, second]), OUTLINE, 2)

    def box(self, truth: RoomGroundTruth, k: int) -> None:
        lines = self.pixels(box_corners(truth.centers_m[k], truth.sizes_m[k]), BOX_EDGES)
        for color, width in (("white", 3), ("black", 1)):
            for line in lines:
                self.draw.line(line, fill=color, width=width)
        if truth.model_ids[k]:  # the front is unknown without a mesh
            self.line(np.stack(_front(truth, k)), (0, 0, 0), 3)


def _truth(shard: Shard, room_id: str) -> RoomGroundTruth | None:
    return shard.read_ground_truth(room_id) if shard.has_ground_truth(room_id) else None


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


def _grid(low: np.ndarray, high: np.ndarray) -> list[tuple[Sequence[float], Sequence[float]]]:
    """Metric grid on the floor, in segments of 1 m, so that clipping one loses little."""
    (x1, z1), (x2, z2) = np.floor(low).astype(int).tolist(), np.ceil(high).astype(int).tolist()
    lines = [((x, 0.0, z), (x, 0.0, z + 1)) for x in range(x1, x2 + 1) for z in range(z1, z2)]
    lines += [((x, 0.0, z), (x + 1, 0.0, z)) for z in range(z1, z2 + 1) for x in range(x1, x2)]
    return lines  # type: ignore[return-value]


def _front(truth: RoomGroundTruth, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Endpoints of a bar on the floor, 0.3 m long, from the centre of the piece's front."""
    yaw, half = float(truth.yaw_rad[k]), truth.sizes_m[k].astype(np.float64) / 2
    ahead = np.array([np.sin(yaw), 0.0, np.cos(yaw)])
    reach = min(half[0] / max(abs(ahead[0]), 1e-9), half[2] / max(abs(ahead[2]), 1e-9))
    foot = truth.centers_m[k].astype(np.float64) - (0, half[1], 0)
    return foot + reach * ahead, foot + (reach + _BAR_M) * ahead


def _tag(draw: ImageDraw.ImageDraw, place: tuple[float, float], text: str, color: Color) -> None:
    left, top, right, bottom = draw.textbbox(place, text, font=font_of(11))
    draw.rectangle((left - 1, top - 1, right + 1, bottom + 1), fill=color)
    draw.text(place, text, fill="white", font=font_of(11))


def _dark(color: np.ndarray) -> Color:
    red, green, blue = (int(channel) * 11 // 20 for channel in color)
    return (red, green, blue)


def font_of(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size=size)
