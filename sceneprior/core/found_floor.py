"""Finds a room's floor, walls and doors from images of stuff (`classes.STUFF`).

Furniture hides parts of floor and walls. `FoundFloor.seen` is the floor that views show;
`FoundFloor.floor` adds the hidden floor, inferred from the walls that were found.
"""

from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Bool, Float
from scipy import ndimage

from sceneprior.core.cameras import camera_centers, to_camera
from sceneprior.core.shards import RoomViews, stuff_step, thinned_intrinsics
from sceneprior.core.wall_lines import BARRIER, COARSE_M, FLOOR, Door, Wall, find_walls, on_floor

CELL_M = 0.03
"""Side of the cells in which the seen floor is collected."""
SEEN_SHARE = 0.1
"""Share of a region between walls that must be visible floor for the region to count as floor."""

OPENED = 4
"""Iterations of the binary opening that removes narrow strips from the area behind walls."""


class FoundFloor(NamedTuple):
    """Floor, walls and doors in the plane y = 0; (x, z) in metres."""

    seen: shapely.Geometry
    """Floor visible in some view; it lies within the true floor."""
    floor: shapely.Geometry
    """Floor between the walls that were found, including the floor that furniture hides."""
    walls: tuple[Wall, ...]
    doors: tuple[Door, ...]


class _Cells(NamedTuple):
    """Grid of square cells in the plane y = 0."""

    low_m: Float[np.ndarray, "2"]
    seen: Bool[np.ndarray, "x z"]
    """True where some view shows floor."""
    outside: Bool[np.ndarray, "x z"]
    """True for cells that a wall hides from some view and that no view shows as floor."""

    @property
    def middles_m(self) -> Float[np.ndarray, "cells 2"]:
        return self.low_m + CELL_M * (np.argwhere(np.ones_like(self.seen)) + 0.5)


def find_floor(room: RoomViews) -> FoundFloor:
    """Find the floor of a room that was read with its images and has `stuff`."""
    walls, doors = find_walls(room)
    cells = _look_at_cells(room)
    seen = _polygon_of(cells, cells.seen)
    eyes = camera_centers(room.world_to_camera)
    return FoundFloor(seen, _between(walls, cells, seen, eyes[:, ::2]), walls, doors)


def _look_at_cells(room: RoomViews) -> _Cells:
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
    empty = np.zeros(shape, dtype=bool)
    middles = _Cells(low, empty, empty).middles_m
    ground = np.insert(middles, 1, 0.0, axis=1)
    floor, wall = (np.zeros(len(ground), dtype=bool) for _ in range(2))
    for stuff, pose, K in views:
        camera = to_camera(ground, pose)
        depth = np.maximum(camera[:, 2], 1e-6)
        u = np.floor(K[0, 0] * camera[:, 0] / depth + K[0, 2])
        v = np.floor(K[1, 1] * camera[:, 1] / depth + K[1, 2])
        there = np.flatnonzero(
            (camera[:, 2] > 0.05) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        )
        at = v[there].astype(int), u[there].astype(int)
        # A pixel at the edge of the floor also covers other surfaces.
        inner = ndimage.binary_erosion(stuff == FLOOR, border_value=1)
        floor[there] |= inner[at]
        wall[there] |= BARRIER[stuff[at]]
    seen, outside = floor.reshape(shape), (wall & ~floor).reshape(shape)
    return _Cells(low, seen, outside)


def _polygon_of(cells: _Cells, which: Bool[np.ndarray, "x z"]) -> shapely.Geometry:
    """Union of the cells selected by `which`."""
    edges = np.diff(np.pad(which, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    rows, starts = np.nonzero(edges == 1)
    _, ends = np.nonzero(edges == -1)
    low = cells.low_m[:, None] + CELL_M * np.stack([rows, starts])
    high = cells.low_m[:, None] + CELL_M * np.stack([rows + 1, ends])
    return shapely.union_all(shapely.box(*low, *high))


def _between(
    walls: tuple[Wall, ...],
    cells: _Cells,
    seen: shapely.Geometry,
    cameras_m: Float[np.ndarray, "views 2"],
) -> shapely.Geometry:
    """Union of the floor regions. The lines of all walls divide the plane into regions; a region is
    floor if enough of it is seen to be floor, or if it holds a camera."""
    if seen.is_empty:
        return seen
    around = shapely.box(*seen.bounds)
    normals = np.array([wall.inward for wall in walls]).reshape(-1, 2)
    offsets = np.array([wall.start_m @ wall.inward for wall in walls])
    along = np.stack([-normals[:, 1], normals[:, 0]], axis=1) * 99
    feet = normals * offsets[:, None]
    lines = shapely.linestrings(np.stack([feet - along, feet + along], axis=1))
    rings = shapely.union_all([*shapely.intersection(lines, around), around.boundary])
    faces = shapely.get_parts(shapely.polygonize(shapely.get_parts(rings)))
    points_m = shapely.get_coordinates(shapely.point_on_surface(faces))

    def sides(points: np.ndarray) -> np.ndarray:
        return np.packbits(points @ normals.T > offsets, axis=1)

    middles = cells.middles_m
    everything = np.concatenate([sides(points_m), sides(middles), sides(cameras_m)])
    face_of = np.unique(everything, axis=0, return_inverse=True)[1].ravel()
    of_faces, of_cells, of_cameras = np.split(face_of, np.cumsum([len(points_m), len(middles)]))
    count = int(face_of.max()) + 1
    floor = np.bincount(of_cells[cells.seen.ravel()], minlength=count)
    outside = np.bincount(of_cells[cells.outside.ravel()], minlength=count)
    has_camera = np.bincount(of_cameras, minlength=count) > 0
    shares = floor[of_faces] * CELL_M**2 / shapely.area(faces)
    is_floor = (shares > SEEN_SHARE) & (floor > outside)[of_faces] | has_camera[of_faces]
    # Narrow strips beside walls are artefacts of the size of pixels and cells.
    beyond = ndimage.binary_opening(cells.outside, iterations=OPENED)
    whole = (shapely.union_all(faces[is_floor]) - _polygon_of(cells, beyond)) | seen
    parts = shapely.get_parts(whole)
    shown = shapely.area(shapely.intersection(parts, seen)) > SEEN_SHARE * shapely.area(parts)
    return shapely.union_all(parts[shown])
