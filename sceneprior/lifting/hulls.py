"""Visual hulls: the cells of a grid that no view shows to be empty of an object.

Laurentini, "The visual hull concept for silhouette-based image understanding", TPAMI 1994. The hull
is an outer bound: where no camera looks behind an object, it goes on behind it. `boxes.py` finds
the smallest box in it that still explains every mask.
"""

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Int, Integer
from numba import njit

from sceneprior.silhouettes.cpu.threads import in_threads

MOST_EMPTY = 0.35
"""A cell that a larger share of views sees past is in no hull, whatever is left unexplained."""
NEVER = 2.0
"""The emptiness of a cell in no hull: more see past it, or fewer than two see the object there."""
MIN_DEPTH_M = 0.1


class Sightings(NamedTuple):
    """The views of one room that see one object."""

    ids: Integer[np.ndarray, "views height width"]
    own_before: Int[np.ndarray, "views bottom right"]
    """How many of the object's pixels lie above and to the left of each pixel's corner, and of the
    image's ends: a summed-area table of (height + 1) x (width + 1)."""
    world_to_image: Float[np.ndarray, "views 3 4"]
    """Intrinsics times `world_to_camera`."""
    focal_px: Float[np.ndarray, " views"]
    own_id: int


class Hull(NamedTuple):
    """A grid of cells between two corners, indexed x, y, z."""

    low_m: Float[np.ndarray, "3"]
    high_m: Float[np.ndarray, "3"]
    emptiness: Float[np.ndarray, "x y z"]
    """Share of the views that look at a cell and see past it, up to `MOST_EMPTY`; else `NEVER`. A
    hull is where this is low; how low, `boxes.py` decides, since masks err."""

    @property
    def cell_m(self) -> Float[np.ndarray, "3"]:
        """Edges of a cell."""
        return (self.high_m - self.low_m) / self.emptiness.shape[0]


def sightings_of(
    ids: Integer[np.ndarray, "views height width"],
    world_to_camera: Float[np.ndarray, "views 4 4"],
    intrinsics: Float[np.ndarray, "views 3 3"],
    own_id: int,
) -> Sightings:
    """Lay out what `carve` reads."""
    views, height, width = ids.shape
    table = np.zeros((views, height + 1, width + 1), dtype=np.int32)
    in_threads(_sum_areas, views, ids, own_id, table)
    matrices = intrinsics.astype(np.float64) @ world_to_camera[:, :3].astype(np.float64)
    return Sightings(ids, table, matrices, intrinsics[:, 0, 0].astype(np.float64), own_id)


def carve(
    seen: Sightings,
    low_m: Float[np.ndarray, "3"],
    high_m: Float[np.ndarray, "3"],
    cells: int,
    reach: float,
) -> Hull:
    """Ask every view about every cell of a grid.

    A view sees past a cell if the pixel there is background and no pixel of the object lies within
    `reach` cells of it, so that parts thinner than a cell survive. A pixel of another object says
    nothing: that may stand in front.
    """
    emptiness = np.empty((cells, cells, cells), dtype=np.float32)
    in_threads(
        _carve, cells, seen.ids, seen.own_before, seen.world_to_image, seen.focal_px, seen.own_id,
        low_m, high_m, reach, emptiness,
    )  # fmt: skip
    return Hull(low_m, high_m, emptiness)


def cells_along(
    hull: Hull,
    origins_m: Float[np.ndarray, "rays 3"],
    directions: Float[np.ndarray, "rays 3"],
    samples: int,
) -> tuple[Int[np.ndarray, "rays samples 3"], Float[np.ndarray, "rays samples"]]:
    """The cells that rays pass through, evenly from entry to exit, and their emptiness."""
    near, far = pass_through(origins_m, directions, hull.low_m, hull.high_m)
    met = far > near
    near, far = np.where(met, near, 0), np.where(met, far, 0)
    steps = (np.arange(samples) + 0.5) / samples
    depth_m = near[:, None] + (far - near)[:, None] * steps
    points_m = origins_m[:, None] + depth_m[..., None] * directions[:, None]
    cells = hull.emptiness.shape[0]
    where = ((points_m - hull.low_m) / hull.cell_m).clip(0, cells - 1).astype(np.int64)
    emptiness = hull.emptiness[tuple(np.moveaxis(where, -1, 0))]
    return where, np.where(met[:, None], emptiness, np.float32(NEVER))


def pass_through(
    origins_m: Float[np.ndarray, "rays 3"],
    directions: Float[np.ndarray, "rays 3"],
    low_m: Float[np.ndarray, "*rays 3"],
    high_m: Float[np.ndarray, "*rays 3"],
) -> tuple[Float[np.ndarray, " rays"], Float[np.ndarray, " rays"]]:
    """Where rays enter and leave axis-aligned boxes; they leave no later than they enter, or
    behind the origin, if they miss. From inside, they enter at 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([low_m - origins_m, high_m - origins_m]) / directions
    # A ray in the plane of a side divides 0 by 0: it is taken to be inside of it.
    near = np.where(np.isnan(ends[0]), -np.inf, ends.min(axis=0)).max(axis=-1)
    far = np.where(np.isnan(ends[0]), np.inf, ends.max(axis=0)).min(axis=-1)
    return near.clip(min=0), far


# no_type_check: the tests' type hook wraps every function, and Numba cannot compile a wrapper.
@njit(cache=True, nogil=True)
@no_type_check
def _sum_areas(first, last, ids, own_id, table):
    _, height, width = ids.shape
    for view in range(first, last):
        for row in range(height):
            so_far = 0
            for column in range(width):
                so_far += ids[view, row, column] == own_id
                table[view, row + 1, column + 1] = table[view, row, column + 1] + so_far


@njit(cache=True, nogil=True)
@no_type_check
def _carve(first, last, ids, table, matrices, focal_px, own_id, low_m, high_m, reach, emptiness):
    views, height, width = ids.shape
    cells = emptiness.shape[0]
    size_m = (high_m - low_m) / cells
    radius_m = reach * size_m.max()
    enough = MOST_EMPTY * views + 0.5  # more than in any hull, whatever the other views see
    for i in range(first, last):
        x = low_m[0] + (i + 0.5) * size_m[0]
        for j in range(cells):
            y = low_m[1] + (j + 0.5) * size_m[1]
            for k in range(cells):
                z = low_m[2] + (k + 0.5) * size_m[2]
                own = 0
                past = 0
                for view in range(views):
                    m = matrices[view]
                    depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
                    if depth < MIN_DEPTH_M:
                        continue
                    u = int(np.floor((m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth))
                    v = int(np.floor((m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth))
                    if u < 0 or v < 0 or u >= width or v >= height:
                        continue
                    radius = int(radius_m * focal_px[view] / depth + 0.5)
                    left, right = max(u - radius, 0), min(u + radius + 1, width)
                    top, bottom = max(v - radius, 0), min(v + radius + 1, height)
                    t = table[view]
                    if t[bottom, right] - t[top, right] - t[bottom, left] + t[top, left] > 0:
                        own += 1
                    elif ids[view, v, u] == 0:
                        past += 1
                        if past > enough:
                            break
                # One view that sees past is forgiven: an outline runs through its pixels.
                emptiness[i, j, k] = NEVER if own < 2 else max(past - 0.5, 0.0) / (own + past)
                if past > enough:
                    emptiness[i, j, k] = NEVER
