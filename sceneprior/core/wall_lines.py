"""Finds the floor that views show, the bases of walls and doors, and the height of the ceiling, in
images of stuff.

The floor is the plane y = 0, so a pixel of it, or on the lower edge of a wall, is one point of the
room without any depth.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from sceneprior.core.cameras import camera_centers, pixel_rays, to_camera
from sceneprior.core.classes import STUFF
from sceneprior.core.observations import RoomViews, stuff_step, thinned_intrinsics

COARSE_M = 0.15
"""Maximum length on the floor that a pixel covers along its ray; coarser pixels are not used."""
NEAR_M = 0.1
"""Maximum distance of a point from its wall."""
FACED = 0.4
"""Sine of the angle between ray and wall that some ray must exceed in each visible part of a wall.
Where a wall occludes the floor behind its corner, the border between them runs along a ray, and is
not the base of a wall."""
SHORTEST_M = 0.3
"""Length of the shortest visible part of a wall."""
GAP_M = 0.3
"""Length of the longest hidden stretch within a part."""
LEAST_VIEWS = 2
"""Minimum number of views that must show a wall."""
NARROWEST_M = 0.5
"""Width of the narrowest door."""
_DIRECTIONS, _OFFSET_M = 180, 0.04
"""Number of directions of normals, and bin width of offsets, in the search for walls."""
_MOST_LINES, _MOST_POINTS, _LEAST_POINTS = 24, 6000, 12
_BIN_M = 0.05
CELL_M = 0.03
"""Side of the cells in which the seen floor is collected."""
_ERROR_PX = 2.0
"""Additional distance in pixels, along its ray, at which a point still belongs to a found line."""
_PIXEL_ERROR_M = 0.01

FLOOR, DOOR = STUFF.index("floor"), STUFF.index("door")
ON_FLOOR, ON_CEILING = np.arange(len(STUFF)) == FLOOR, np.isin(STUFF, "ceiling")
BARRIER = np.isin(STUFF, ("wall", "door", "window"))
"""True for values of stuff that stand on the floor and hide the space behind them."""


class Wall(NamedTuple):
    """A visible part of the base of a wall, door or window; (x, z) in metres."""

    start_m: Float[np.ndarray, "2"]
    end_m: Float[np.ndarray, "2"]
    inward: Float[np.ndarray, "2"]
    """Unit normal, into the room."""
    error_m: float
    """Standard error of the wall's offset along its normal, from the differences between views."""


class Door(NamedTuple):
    """The base of a door; (x, z) in metres."""

    start_m: Float[np.ndarray, "2"]
    end_m: Float[np.ndarray, "2"]


class _Edges(NamedTuple):
    """Points at which floor meets a wall, a door or a window."""

    points_m: Float[np.ndarray, "points 2"]
    towards_camera: Float[np.ndarray, "points 2"]
    weight: Float[np.ndarray, " points"]
    """Inverse square of the pixel's length on the floor, to which errors of poses and masks are
    proportional."""
    view: Int[np.ndarray, " points"]
    is_door: Bool[np.ndarray, " points"]

    def take(self, which: np.ndarray | slice) -> "_Edges":
        return _Edges(*(part[which] for part in self))


class _Line(NamedTuple):
    """Points p with p @ normal == offset_m; the normal points into the room."""

    normal: Float[np.ndarray, "2"]
    offset_m: float

    def has(self, edges: _Edges, pixels: float = 0.0) -> Bool[np.ndarray, " points"]:
        """True for points that face the line, and whose distance from it is at most `NEAR_M` plus
        the size of `pixels` pixels."""
        facing = edges.towards_camera @ self.normal
        within_m = NEAR_M + pixels * edges.weight**-0.5 * facing
        near = np.abs(edges.points_m @ self.normal - self.offset_m) < within_m
        return near & (facing > 0)


def seen_floor(room: RoomViews) -> shapely.Geometry:
    """The floor (x, z) that some view of a room with `stuff` shows, part of the true floor."""
    assert room.stuff is not None
    _, height, width = room.stuff.shape
    poses = room.world_to_camera.astype(np.float64)
    intrinsics = thinned_intrinsics(room.intrinsics, stuff_step(room.image_size))
    views = list(zip(room.stuff, poses, intrinsics, strict=True))
    corners = []
    for stuff, pose, K in views:
        rows, columns = np.nonzero(stuff[::4, ::4] == FLOOR)
        points_m, length_m, _ = on_floor(np.stack([columns, rows], axis=1) * 4 + 0.5, pose, K)
        corners.append(points_m[length_m < 2 * COARSE_M])
    points_m = np.concatenate([*corners, np.zeros((1, 2))])
    low = points_m.min(axis=0) - 2 * CELL_M
    shape = np.ceil((points_m.max(axis=0) + 2 * CELL_M - low) / CELL_M).astype(int)
    middles = low + CELL_M * (np.argwhere(np.ones(shape, dtype=bool)) + 0.5)
    ground = np.insert(middles, 1, 0.0, axis=1)
    floor = np.zeros(len(ground), dtype=bool)
    for stuff, pose, K in views:
        camera = to_camera(ground, pose)
        depth = np.maximum(camera[:, 2], 1e-6)
        u = np.floor(K[0, 0] * camera[:, 0] / depth + K[0, 2])
        v = np.floor(K[1, 1] * camera[:, 1] / depth + K[1, 2])
        there = np.flatnonzero(
            (camera[:, 2] > 0.05) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        )
        # A pixel at the edge of the floor also covers other surfaces.
        inner = ndimage.binary_erosion(stuff == FLOOR, border_value=1)
        floor[there] |= inner[v[there].astype(int), u[there].astype(int)]
    # One rectangle for each run of cells along z.
    edges = np.diff(np.pad(floor.reshape(shape), ((0, 0), (1, 1))).astype(np.int8), axis=1)
    rows, starts = np.nonzero(edges == 1)
    _, ends = np.nonzero(edges == -1)
    near = low[:, None] + CELL_M * np.stack([rows, starts])
    far = low[:, None] + CELL_M * np.stack([rows + 1, ends])
    return shapely.union_all(shapely.box(*near, *far))


def find_walls(
    room: RoomViews,
    views: Sequence[int] | np.ndarray | None = None,
    ceiling_m: float | None = None,
) -> tuple[tuple[Wall, ...], tuple[Door, ...]]:
    """Find the bases of walls and doors that `views` (None: all) of a room with `stuff` show; with
    `ceiling_m`, its height, the tops of walls in place of bases.

    Lines are found one after another, each where most points lie (a Hough transform), and fitted to
    the points near them. Walls may have any direction.
    """
    views = range(len(room.world_to_camera)) if views is None else views
    every = zip(*(_edges_of_view(room, int(view), ceiling_m) for view in views), strict=True)
    edges = _Edges(*(np.concatenate(part) for part in every))
    edges = edges.take(slice(None, None, max(1, len(edges.view) // _MOST_POINTS)))
    walls: list[Wall] = []
    doors: list[Door] = []
    for _ in range(_MOST_LINES):
        if len(edges.view) < _LEAST_POINTS:
            break
        line = _fitted(edges, _most_voted(edges))
        on = line.has(edges)
        walls += _parts(edges.take(on), line)
        doors += _doors(edges.take(on), line)
        edges = edges.take(~line.has(edges, _ERROR_PX))
    return tuple(walls), tuple(doors)


def find_ceiling(
    room: RoomViews, walls: Sequence[Wall], views: Sequence[int] | np.ndarray
) -> float | None:
    """Height in metres of the ceiling that `views` of a room with `stuff` show: the median height
    at which it meets its found walls. None if too few pixels show that."""
    found = [np.zeros(0)]
    for view in map(int, views) if walls else ():
        pose, K, pixels, _ = _borders(room, view, ON_CEILING, BARRIER)
        eye, rays = camera_centers(pose), pixel_rays(pixels[::4], pose, K)
        distances = np.full((len(rays), len(walls)), np.inf)
        for row, (start, end, inward, _) in enumerate(walls):
            towards = np.minimum(rays[:, ::2] @ inward, -1e-9)
            reach = (start - eye[::2]) @ inward / towards
            along = (eye[::2] + reach[:, None] * rays[:, ::2] - start) @ (end - start)
            on = (reach > 0) & (along >= 0) & (along <= (end - start) @ (end - start))
            distances[on, row] = reach[on]
        heights_m = eye[1] + distances.min(axis=1) * rays[:, 1]
        found.append(heights_m[np.isfinite(heights_m)])
    heights_m = np.concatenate(found)
    return float(np.median(heights_m)) if len(heights_m) >= _LEAST_POINTS else None


def _edges_of_view(room: RoomViews, view: int, ceiling_m: float | None) -> _Edges:
    surfaces = (BARRIER, ON_FLOOR) if ceiling_m is None else (ON_CEILING, BARRIER)
    pose, K, pixels, kinds = _borders(room, view, *surfaces)
    points_m, length_m, towards = on_floor(pixels, pose, K, ceiling_m or 0.0)
    near = length_m < COARSE_M
    return _Edges(
        points_m[near], towards[near], length_m[near] ** -2, np.full(near.sum(), view),
        kinds[near] == DOOR,
    )  # fmt: skip


def _borders(
    room: RoomViews, view: int, above: Bool[np.ndarray, " stuff"], below: Bool[np.ndarray, " stuff"]
) -> tuple[
    Float[np.ndarray, "4 4"], Float[np.ndarray, "3 3"], Float[np.ndarray, "points 2"], np.ndarray
]:
    """Pose and intrinsics of a view's stuff, the pixels (x, y) at which stuff of some values ends
    above stuff of other values, and the upper values."""
    assert room.stuff is not None
    pose = room.world_to_camera[view].astype(np.float64)
    K = thinned_intrinsics(room.intrinsics[view], stuff_step(room.image_size))
    image, up = room.stuff[view], pose[:2, 1]
    # Turned by quarter turns, so that the room's up direction is the image's, up to 45 degrees.
    sideways = abs(up[0]) > abs(up[1])
    upside_down = up[0 if sideways else 1] > 0
    image = image.T if sideways else image
    image = image[::-1] if upside_down else image
    rows, columns = np.nonzero(below[image[1:]] & above[image[:-1]])
    along = len(image) - rows - 1 if upside_down else rows + 1
    # The border is at the boundary of the two pixels.
    pixels = np.stack([columns + 0.5, along], axis=1)[:, :: -1 if sideways else 1]
    return pose, K, pixels, image[rows, columns]


def on_floor(
    pixels: Float[np.ndarray, "points 2"],
    world_to_camera: Float[np.ndarray, "4 4"],
    intrinsics: Float[np.ndarray, "3 3"],
    height_m: float = 0.0,
) -> tuple[
    Float[np.ndarray, "points 2"], Float[np.ndarray, " points"], Float[np.ndarray, "points 2"]
]:
    """Points (x, z) at which the rays through pixels meet the plane y = `height_m`, the length in
    metres along the ray that one pixel covers there (inf for rays that do not meet it), and unit
    vectors to below or above the camera."""
    eye = camera_centers(world_to_camera)
    focal = intrinsics[[0, 1], [0, 1]]
    rays = pixel_rays(pixels, world_to_camera, intrinsics)
    away = eye[1] - height_m
    reach = rays[:, ::2] * (abs(away) / np.maximum(-rays[:, 1] * np.sign(away), 1e-9))[:, None]
    distance = np.linalg.norm(reach, axis=1)
    meets = rays[:, 1] * away < 0
    length = np.where(meets, (away**2 + distance**2) / max(abs(away), 1e-9) / focal.mean(), np.inf)
    return eye[::2] + reach, length, -reach / np.maximum(distance, 1e-9)[:, None]


def _most_voted(edges: _Edges) -> _Line:
    angles = np.arange(_DIRECTIONS) * (2 * np.pi / _DIRECTIONS)
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    offsets = edges.points_m @ normals.T
    bins = np.floor((offsets - offsets.min()) / _OFFSET_M).astype(np.int64)
    count = int(bins.max()) + 2
    facing = edges.towards_camera @ normals.T > 0
    votes = np.bincount(
        (bins + count * np.arange(_DIRECTIONS))[facing],
        np.broadcast_to(edges.weight[:, None], facing.shape)[facing],
        count * _DIRECTIONS,
    )
    votes[:-1] += votes[1:]  # a wall may lie between two bins
    direction, place = divmod(int(votes.argmax()), count)
    return _Line(normals[direction], float(offsets.min() + (place + 1) * _OFFSET_M))


def _fitted(edges: _Edges, line: _Line) -> _Line:
    """Fit a line to the points near it, by weighted least squares of their distances."""
    for _ in range(3):
        near = edges.take(line.has(edges))
        if len(near.view) < _LEAST_POINTS:
            break
        middle = np.average(near.points_m, axis=0, weights=near.weight)
        apart = (near.points_m - middle) * near.weight[:, None] ** 0.5
        normal = np.linalg.svd(apart.T @ apart)[0][:, 1]
        normal = normal * np.sign(normal @ line.normal)
        line = _Line(normal, float(middle @ normal))
    return line


def _runs(along_m: Float[np.ndarray, " points"]) -> list[Int[np.ndarray, " run"]]:
    """Split points along a line where there is a gap; indices of the points of each part."""
    order = np.argsort(along_m, kind="stable")
    if not len(order):
        return []
    return np.split(order, np.flatnonzero(np.diff(along_m[order]) > GAP_M) + 1)


def _parts(on: _Edges, line: _Line) -> list[Wall]:
    found = []
    along = np.array([-line.normal[1], line.normal[0]])
    along_m = on.points_m @ along
    for run in _runs(along_m):
        ends = along_m[run].min(), along_m[run].max()
        part = on.take(run)
        views = np.unique(part.view)
        faced = (part.towards_camera @ line.normal).max() > FACED
        if not faced or len(views) < LEAST_VIEWS or ends[1] - ends[0] < SHORTEST_M:
            continue
        off = part.points_m @ line.normal - line.offset_m
        weights = np.array([part.weight[part.view == view].sum() for view in views])
        means = np.array(
            [np.average(off[part.view == v], weights=part.weight[part.view == v]) for v in views]
        )
        spread = weights**2 @ (
            (means - np.average(means, weights=weights)) ** 2 + _PIXEL_ERROR_M**2
        )
        error = spread**0.5 / weights.sum()
        start, end = (end * along + line.offset_m * line.normal for end in ends)
        found.append(Wall(start, end, line.normal, float(error)))
    return found


def _doors(on: _Edges, line: _Line) -> list[Door]:
    """Doors: stretches of the line along which most points are on doors."""
    along = np.array([-line.normal[1], line.normal[0]])
    along_m = on.points_m @ along
    first = along_m.min(initial=0.0)
    bins = np.floor((along_m - first) / _BIN_M).astype(np.int64)
    count = int(bins.max(initial=0)) + 1
    doors, others = (
        np.bincount(bins[which], minlength=count) for which in (on.is_door, ~on.is_door)
    )
    is_door = on.is_door & (doors > others)[bins]
    found = []
    for run in _runs(along_m[is_door]):
        ends = along_m[is_door][run].min(), along_m[is_door][run].max()
        views = np.unique(on.view[is_door][run])
        if len(views) >= LEAST_VIEWS and ends[1] - ends[0] >= NARROWEST_M:
            found.append(Door(*(end * along + line.offset_m * line.normal for end in ends)))
    return found
