"""Visual hulls: the grid cells that no view, or only a few, show to be outside an object.

Laurentini, "The visual hull concept for silhouette-based image understanding", TPAMI 1994. The hull
is an outer bound: it extends behind an object wherever no camera sees that space. `boxes.py` finds
the smallest box in it that still explains every mask.
"""

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int, Integer, Real
from numba import njit

from sceneprior.core.cameras import pixel_rays
from sceneprior.core.observations import RoomViews
from sceneprior.lifted.lifting import LiftedBoxes, ShapeGrid
from sceneprior.render.silhouettes.cpu.kernels import in_threads

MOST_EMPTY = 0.35
"""Largest emptiness of a cell in any hull, even if rays then stay unexplained; see
`Hull.emptiness`."""
NEVER = 2.0
"""Emptiness of a cell that is in no hull: too many views see past it, or fewer than two see the
object there."""
MIN_DEPTH_M = 0.1
"""Depth below which a cell is not projected into a view."""
REACH = 0.4
"""`reach` of `hulls.carve`, in cells: parts of this thickness are kept."""
EMPTY = 0.05
"""Threshold: a cell counts as empty if a larger share of the views sees past it. The threshold in
`boxes.py` is higher, because there one wrong cell can move a whole side of a box."""


class Sightings(NamedTuple):
    """The views of one room that show one object."""

    ids: Integer[np.ndarray, "views height width"]
    own_id: int
    boxes_px: Int[np.ndarray, "views 4"]
    """First column and row of the object's pixels, and one past the last of each."""
    own_before: Int[np.ndarray, " corners"]
    """Summed-area tables of the object's pixels in its 2D box: for each pixel corner, the number of
    the object's pixels above and to the left. Tables have (height + 1) x (width + 1) entries of the
    box, and follow each other view by view."""
    table_starts: Int[np.ndarray, " views"]
    """Start of each view's table in `own_before`."""
    world_to_image: Float[np.ndarray, "views 3 4"]
    """Intrinsics times `world_to_camera`."""
    focal_px: Float[np.ndarray, " views"]
    boxes: Float[np.ndarray, "views 4"]
    """2D boxes, relative to the image's size."""
    sides_clear: Bool[np.ndarray, "views 4"]
    """True where the object itself ends at a side of its 2D box; see `RoomViews`."""
    world_to_camera: Float[np.ndarray, "views 4 4"]
    intrinsics: Float[np.ndarray, "views 3 3"]

    @classmethod
    def of(cls, views: RoomViews, item: int) -> "Sightings":
        """The views of a room, read with its images, that show an object."""
        assert views.instance_ids is not None, "lifting reads images"
        rows = np.flatnonzero(views.visible[:, item])
        ids, boxes = views.instance_ids[rows], views.boxes[rows, item]
        height, width = views.image_size
        size = np.array([width, height, width, height])
        # Clipped as a safeguard: compiled code checks no index.
        boxes_px = np.rint(np.nan_to_num(boxes) * size).clip(0, size).astype(np.int64)
        boxes_px[:, 2:] = np.maximum(boxes_px[:, 2:], boxes_px[:, :2])
        sizes = np.prod(boxes_px[:, 2:] - boxes_px[:, :2] + 1, axis=1)
        starts, tables = np.cumsum(sizes) - sizes, np.zeros(sizes.sum(), np.int32)
        for image, box_px, start in zip(ids, boxes_px, starts, strict=True):
            _count_before(image, item + 1, box_px, tables[start:])
        poses, intrinsics = views.world_to_camera[rows], views.intrinsics[rows]
        exact = intrinsics.astype(np.float64)
        matrices = exact @ poses[:, :3].astype(np.float64)
        return cls(
            ids, item + 1, boxes_px, tables, starts, matrices,
            exact[:, 0, 0].copy(), boxes, views.sides_clear[rows, item], poses, intrinsics,
        )  # fmt: skip

    def directions(
        self, view: int, u: Real[np.ndarray, " rays"], v: Real[np.ndarray, " rays"]
    ) -> Float[np.ndarray, "rays 3"]:
        """Unit directions, in the room frame, of rays through the centres of a view's pixels."""
        places = np.stack([u, v], axis=-1) + 0.5
        rays = pixel_rays(places, self.world_to_camera[view], self.intrinsics[view])
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


class Hull(NamedTuple):
    """A grid of cells between two corners, indexed x, y, z."""

    low_m: Float[np.ndarray, "3"]
    high_m: Float[np.ndarray, "3"]
    emptiness: Float[np.ndarray, "x y z"]
    """Share of the views with evidence about a cell that see past it, after half a view is
    subtracted from these; `NEVER` for a cell that `carve` rules out. The hull consists of the cells
    up to a threshold, which `boxes.py` and `lift_shapes` choose, since masks have errors."""

    @property
    def cell_m(self) -> Float[np.ndarray, "3"]:
        """Edge lengths of a cell."""
        return (self.high_m - self.low_m) / self.emptiness.shape[0]


def carve(
    seen: Sightings,
    low_m: Float[np.ndarray, "3"],
    high_m: Float[np.ndarray, "3"],
    cells: int,
    reach: float,
    most_empty: float = MOST_EMPTY,
) -> Hull:
    """Count, for every cell of a grid, the views that see past it, and those that see the object
    there. A cell is ruled out if more than the share `most_empty` of all views see past it (half a
    view more is allowed), or if fewer than two see the object there.

    A view sees past a cell if the pixel there is background and no pixel of the object lies within
    `reach` cells of it, so that parts thinner than a cell survive. Pixels of other objects, which
    may be occluders, are no evidence, and neither are cells outside the image.
    """
    emptiness = np.empty((cells, cells, cells), dtype=np.float32)
    in_threads(
        _carve, cells, seen.ids, seen.own_id, seen.boxes_px, seen.own_before, seen.table_starts,
        seen.world_to_image, seen.focal_px, low_m, high_m, reach, most_empty, emptiness,
    )  # fmt: skip
    return Hull(low_m, high_m, emptiness)


def lift_shapes(
    views: RoomViews, boxes: LiftedBoxes, shape: ShapeGrid
) -> Bool[np.ndarray, "objects x y z"]:
    """The visual hull of each of a room's objects, on a grid in the frame of its box.

    True in cells that the object may fill, never outside the box; all False for an object without
    a box. `views` are those of `lift_boxes`.
    """
    cells, margin = shape.cells, shape.margin
    grids = np.zeros((len(views.object_class), cells, cells, cells), dtype=bool)
    # Cells whose centres lie in the box.
    inside = np.abs((np.arange(cells) + 0.5) / cells - 0.5) * margin < 0.5
    for item in np.flatnonzero(boxes.explained > 0).tolist():
        half_m = margin * boxes.sizes_m[item] / 2
        low_m, high_m = boxes.centers_m[item] - half_m, boxes.centers_m[item] + half_m
        hull = carve(Sightings.of(views, item), low_m, high_m, cells, REACH, EMPTY)
        grids[item] = (hull.emptiness <= EMPTY) & inside & inside[:, None] & inside[:, None, None]
    return grids


# no_type_check: the tests' type hook wraps every function, and Numba cannot compile a wrapper.
@njit(cache=True, nogil=True)
@no_type_check
def _count_before(image, own_id, box_px, table):
    """Fill in the table of a view; its first row and column stay 0."""
    x1, y1, x2, y2 = box_px
    columns = x2 - x1 + 1
    for row in range(y2 - y1):
        total, place = 0, (row + 1) * columns
        for column in range(x2 - x1):
            total += image[y1 + row, x1 + column] == own_id
            table[place + column + 1] = table[place - columns + column + 1] + total


@njit(cache=True, nogil=True)
@no_type_check
def own_in(box_px, table, start, x1, y1, x2, y2):
    """Number of the object's pixels in columns x1 to x2 and rows y1 to y2 (one past the last) of a
    view; `start` is the start of the view's table."""
    x1, x2 = max(x1, box_px[0]) - box_px[0], min(x2, box_px[2]) - box_px[0]
    y1, y2 = max(y1, box_px[1]) - box_px[1], min(y2, box_px[3]) - box_px[1]
    if x1 >= x2 or y1 >= y2:
        return 0
    columns = box_px[2] - box_px[0] + 1
    top, bottom = start + y1 * columns, start + y2 * columns
    return table[bottom + x2] - table[top + x2] - table[bottom + x1] + table[top + x1]


# "numpy": division by zero raises no error, so that a row of cells can be projected at once.
@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _carve(
    first, last, ids, own_id, boxes_px, table, starts, matrices, focal_px, low_m, high_m, reach,
    most_empty, emptiness,
):  # fmt: skip
    views, height, width = ids.shape
    cells = emptiness.shape[0]
    size_m = (high_m - low_m) / cells
    radius_m = reach * size_m.max()
    enough = most_empty * views + 0.5  # over the limit, whatever the other views see
    own, past = np.empty((cells, cells), np.int32), np.empty((cells, cells), np.int32)
    u, v, depth = np.empty(cells), np.empty(cells), np.empty(cells)
    z = low_m[2] + (np.arange(cells) + 0.5) * size_m[2]
    for i in range(first, last):
        own[:] = 0
        past[:] = 0
        x = low_m[0] + (i + 0.5) * size_m[0]
        for view in range(views):  # outer loop: keeps the view's image in the cache
            m = matrices[view]
            box, start = boxes_px[view], starts[view]
            for j in range(cells):
                y = low_m[1] + (j + 0.5) * size_m[1]
                a = m[0, 0] * x + m[0, 1] * y
                b = m[1, 0] * x + m[1, 1] * y
                c = m[2, 0] * x + m[2, 1] * y
                for k in range(cells):
                    depth[k] = c + m[2, 2] * z[k] + m[2, 3]
                    u[k] = (a + m[0, 2] * z[k] + m[0, 3]) / depth[k]
                    v[k] = (b + m[1, 2] * z[k] + m[1, 3]) / depth[k]
                for k in range(cells):
                    if past[j, k] > enough or depth[k] < MIN_DEPTH_M:
                        continue
                    if not (0 <= u[k] < width and 0 <= v[k] < height):
                        continue
                    column, row = int(u[k]), int(v[k])
                    here = ids[view, row, column]
                    radius = int(radius_m * focal_px[view] / depth[k] + 0.5)
                    if here == own_id or own_in(
                        box, table, start,
                        column - radius, row - radius, column + radius + 1, row + radius + 1,
                    ):  # fmt: skip
                        own[j, k] += 1
                    elif here == 0:
                        past[j, k] += 1
        for j in range(cells):
            for k in range(cells):
                # Half a view is subtracted: an object's outline runs through pixels.
                share = max(past[j, k] - 0.5, 0.0) / (own[j, k] + past[j, k])
                never = own[j, k] < 2 or past[j, k] > enough
                emptiness[i, j, k] = NEVER if never else share
