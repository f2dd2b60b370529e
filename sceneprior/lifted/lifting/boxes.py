"""Boxes and rays of tracked objects: the smallest 3D box that explains an object's masks in all
views, and rays around the masks, which either meet the object or pass through empty space."""

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from sceneprior.core.cameras import camera_centers, nearest_to_rays
from sceneprior.core.observations import RoomViews
from sceneprior.lifted.lifting import LiftedBoxes, RayPool
from sceneprior.lifted.lifting.hidden_sides import moved_to_planes
from sceneprior.lifted.lifting.hulls import MOST_EMPTY, NEVER, Hull, Sightings, carve, own_in
from sceneprior.render.silhouettes.cpu.kernels import in_threads

GRIDS = ((16, 0.6), (24, 0.6), (40, 0.4), (40, 0.4))
"""Grids, coarse to fine: cells along an edge, and `reach` (see `carve`). Each grid spans the box
found on the previous grid, plus one cell at each side."""
EXPLAINED = 0.985
"""Share of an object's rays that its hull must meet; the others may be wrong pixels."""
RAYS = 400
"""Approximate number of rays per object; see `own_rays`."""
TRIM = 0.3
"""Distance in cells by which a box's sides are moved inwards from its outermost cells, which are
only partly filled."""
UNKNOWN_DISTANCE_M = 2.5
"""Assumed distance of an object from its cameras where the views do not determine it, as with a
single view."""
NEAR_OUTLINE_PX = 4
"""Half the width in pixels of the band around a mask's outline from which half of the rays come."""
FAR_M = 100.0
"""Length of rays that no object stops."""


def lift_boxes(views: RoomViews, planes: Float[np.ndarray, "planes 4"]) -> LiftedBoxes:
    """3D boxes of a room's objects, from instance ids and cameras; no 3D ground truth is used.

    An object's visual hull is carved coarse to fine. On each grid, the sides of the box are moved
    inwards one after another, as long as every ray through one of the object's pixels still meets
    a cell of the hull inside the box. The next grid spans only this box, which drops the parts of
    the hull that no ray needs. At last, hidden sides are moved to the room's `planes`
    (`hidden_sides.py`). `views` is a room, read with its images.
    """
    rng = np.random.default_rng(0)
    count = len(views.object_class)
    sides_m, explained = np.zeros((count, 2, 3)), np.zeros(count)
    for item in range(count):
        seen = Sightings.of(views, item)
        *found, explained[item] = _lift(seen, rng)
        known = explained[item] > 0
        sides_m[item] = moved_to_planes(seen, np.array(found), planes) if known else found
    return LiftedBoxes(sides_m.mean(axis=1), sides_m[:, 1] - sides_m[:, 0], explained)


def _lift(seen: Sightings, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, float]:
    """Lower and upper corner of an object's box, and the share of rays that meet it."""
    if not len(seen.ids):
        return np.full(3, -0.5), np.full(3, 0.5), 0.0
    origins_m, directions = own_rays(seen, rng)
    low_m, high_m = _where_to_look(seen)
    for cells, reach in GRIDS:
        hull = carve(seen, low_m, high_m, cells, reach)
        where, emptiness = cells_along(hull, origins_m, directions, 3 * cells)
        # The emptiness at which the hull meets the share `EXPLAINED` of the rays.
        least = emptiness.min(axis=1)
        met = least[least <= 1]
        limit = min(float(np.quantile(met, EXPLAINED)), MOST_EMPTY) if len(met) else MOST_EMPTY
        in_hull = emptiness <= limit
        first, last = smallest_box(where, in_hull, cells)
        if not in_hull.any():
            break
        low_m = hull.low_m + (first - 1) * hull.cell_m
        high_m = hull.low_m + (last + 1) * hull.cell_m
    trim = np.where(last - first > 1, TRIM, 0.0)
    explained = float(in_hull.any(axis=1).mean())
    return (
        hull.low_m + (first + trim) * hull.cell_m,
        hull.low_m + (last - trim) * hull.cell_m,
        explained,
    )


def cells_along(
    hull: Hull,
    origins_m: Float[np.ndarray, "rays 3"],
    directions: Float[np.ndarray, "rays 3"],
    samples: int,
) -> tuple[Int[np.ndarray, "rays samples 3"], Float[np.ndarray, "rays samples"]]:
    """Cells at evenly spaced samples of rays, from entry to exit, and their emptiness; `NEVER` all
    along a ray that misses the grid."""
    near, far = pass_through(origins_m, directions, hull.low_m, hull.high_m)
    where = np.empty((len(near), samples, 3), dtype=np.int32)
    emptiness = np.empty((len(near), samples), dtype=np.float32)
    in_threads(
        _cells_along, len(near), origins_m, directions, near, far, hull.low_m, hull.cell_m,
        hull.emptiness, where, emptiness,
    )  # fmt: skip
    return where, emptiness


def pass_through(
    origins_m: Float[np.ndarray, "rays 3"],
    directions: Float[np.ndarray, "rays 3"],
    low_m: Float[np.ndarray, "*rays 3"],
    high_m: Float[np.ndarray, "*rays 3"],
) -> tuple[Float[np.ndarray, " rays"], Float[np.ndarray, " rays"]]:
    """Distances at which rays enter and leave axis-aligned boxes. A ray that misses leaves no later
    than it enters, or behind the origin. A ray that starts inside enters at 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([low_m - origins_m, high_m - origins_m]) / directions
    # A ray in the plane of a side divides 0 by 0; it counts as inside.
    near = np.where(np.isnan(ends[0]), -np.inf, ends.min(axis=0)).max(axis=-1)
    far = np.where(np.isnan(ends[0]), np.inf, ends.max(axis=0)).min(axis=-1)
    return near.clip(min=0), far


def smallest_box(
    where: Int[np.ndarray, "rays samples 3"],
    in_hull: Bool[np.ndarray, "rays samples"],
    cells: int,
) -> tuple[Int[np.ndarray, "3"], Int[np.ndarray, "3"]]:
    """Move each side inwards as far as every ray that meets the hull still meets it inside the box.

    Sides are moved in the order x, y, z; returns the first and one past the last cell per axis.
    """
    met = in_hull.any(axis=1)
    where, inside = where[met], in_hull[met]
    first, last = np.zeros(3, dtype=np.int64), np.full(3, cells)
    if not len(inside):
        return first, last
    for axis in range(3):
        at = where[..., axis]
        # Each ray must meet a cell at or beyond the side, which bounds how far the side can move.
        first[axis] = np.where(inside, at, -1).max(axis=1).min()
        inside = inside & (at >= first[axis])
        last[axis] = np.where(inside, at, cells).min(axis=1).max() + 1
        inside = inside & (at < last[axis])
    return first, last


def own_rays(
    seen: Sightings, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "rays 3"], Float[np.ndarray, "rays 3"]]:
    """Origins and unit directions of rays through an object's pixels.

    About `RAYS` of them go through random pixels of the object's masks. In every view, further rays
    go through the outermost pixel at each side where the object itself ends, rather than where an
    occluder cuts it off; these rays determine the object's extent.
    """
    each = max(4, RAYS // len(seen.ids))
    origins, directions = [], []
    for view, (x1, y1, x2, y2) in enumerate(seen.boxes_px):
        v, u = np.nonzero(seen.ids[view, y1:y2, x1:x2] == seen.own_id)
        v, u = v + y1, u + x1
        ends = np.array([u.argmin(), v.argmin(), u.argmax(), v.argmax()])
        outermost = ends[seen.sides_clear[view]]
        picked = np.concatenate([rng.integers(len(u), size=each), outermost])
        directions.append(seen.directions(view, u[picked], v[picked]))
        eye_m = camera_centers(seen.world_to_camera[view])
        origins.append(np.broadcast_to(eye_m, directions[-1].shape))
    return np.concatenate(origins).astype(np.float64), np.concatenate(directions)


def _where_to_look(seen: Sightings) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Lower and upper corner of a cube that contains the object. Its centre is the point nearest to
    the rays through the centres of the object's 2D boxes."""
    height, width = seen.ids.shape[1:]
    boxes_px = seen.boxes * np.array([width, height, width, height])
    middle_px = (boxes_px[:, :2] + boxes_px[:, 2:]) / 2 - 0.5
    cameras_m = camera_centers(seen.world_to_camera)
    rays = np.concatenate(
        [seen.directions(view, pixel[:1], pixel[1:]) for view, pixel in enumerate(middle_px)]
    )
    guess_m = (cameras_m + UNKNOWN_DISTANCE_M * rays).mean(axis=0)
    middle_m = nearest_to_rays(cameras_m, rays, 1e-3, guess_m)
    spans = (boxes_px[:, 2:] - boxes_px[:, :2]) / seen.intrinsics[:, [0, 1], [0, 1]]
    distances_m = np.linalg.norm(middle_m - cameras_m, axis=-1)
    radius_m = 1.3 * float((np.linalg.norm(spans, axis=-1) / 2 * distances_m).max()) + 0.15
    return middle_m - radius_m, middle_m + radius_m


def draw_rays(views: RoomViews, boxes: LiftedBoxes, count: int, margin: float) -> RayPool:
    """`count` rays per object, through pixels in and around its mask in every view that shows it.

    A pixel of another object shows that the ray is empty up to that object's box; beyond it, this
    object may be hidden. If the other box is unknown, or the pixel is void, the ray carries no
    information. Walls, floor and everything without an id count as background.

    `margin` is the extent of an object's frame, relative to its box; `views` and `boxes` are those
    of `lift_boxes` and its result.
    """
    rng = np.random.default_rng([0, 1])
    objects = len(views.object_class)
    starts, spans = np.zeros((2, objects, count, 3), np.float32)
    hits = np.zeros((objects, count), bool)
    for item in range(objects):
        found = _draw(Sightings.of(views, item), boxes, count, margin, rng)
        if found is not None:
            starts[item], spans[item], hits[item] = found
    return RayPool(starts, spans, hits)


def _draw(
    seen: Sightings, boxes: LiftedBoxes, count: int, margin: float, rng: np.random.Generator
) -> RayPool | None:
    """The rays of one object; None if none carries information."""
    if not len(seen.ids):
        return None
    item = seen.own_id - 1
    view, u, v = _pixels_round(seen, 6 * count, rng)
    ids = seen.ids[view, v, u].astype(np.int64)
    directions = np.empty((len(u), 3))
    for row in range(len(seen.ids)):
        directions[view == row] = seen.directions(row, u[view == row], v[view == row])
    origins_m = camera_centers(seen.world_to_camera)[view].astype(np.float64)
    until_m = np.where((ids == 0) | (ids == seen.own_id), FAR_M, 0.0)
    # Indexed by id: True for other objects with a known box. Id 0 is background, the last id void.
    has_box = np.concatenate([[False], boxes.explained > 0, [False]])
    has_box[seen.own_id] = False
    other = has_box[ids]
    centers_m = boxes.centers_m[ids[other] - 1]
    its_half_m = 1.05 * boxes.sizes_m[ids[other] - 1] / 2  # a margin for errors of the boxes
    near, far = pass_through(
        origins_m[other], directions[other], centers_m - its_half_m, centers_m + its_half_m
    )
    until_m[other] = np.where(far > near, near, 0)
    half_m = margin * boxes.sizes_m[item] / 2
    near, far = pass_through(
        origins_m, directions, boxes.centers_m[item] - half_m, boxes.centers_m[item] + half_m
    )
    far = np.minimum(far, until_m)
    useful = np.flatnonzero(far > near)
    if not len(useful):
        return None
    near_outline = np.empty(len(useful), bool)
    in_threads(
        _near_outline, len(useful), view[useful], u[useful], v[useful], seen.ids.shape[1:],
        seen.boxes_px, seen.own_before, seen.table_starts, near_outline,
    )  # fmt: skip
    weights = near_outline.astype(np.float64)
    share = weights.mean()
    if 0 < share < 1:
        weights = weights / share + (1 - weights) / (1 - share)
    else:
        weights = np.ones(len(useful))
    drawn = rng.choice(useful, count, p=weights / weights.sum())
    origin, ray = (origins_m[drawn] - boxes.centers_m[item]) / half_m, directions[drawn] / half_m
    return RayPool(
        (origin + near[drawn, None] * ray).astype(np.float32),
        ((far - near)[drawn, None] * ray).astype(np.float32),
        ids[drawn] == seen.own_id,
    )


def _pixels_round(
    seen: Sightings, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """View, column and row of random pixels in the object's 2D boxes, widened by a sixth and 8
    pixels."""
    height, width = seen.ids.shape[1:]
    size = np.array([width, height])
    boxes_px = seen.boxes.reshape(-1, 2, 2) * size
    wider = 8 + (boxes_px[:, 1] - boxes_px[:, 0]) / 6
    low = (boxes_px[:, 0] - wider).clip(0)
    high = np.minimum(boxes_px[:, 1] + wider, size)
    view = np.repeat(np.arange(len(seen.ids)), -(-count // len(seen.ids)))
    places = low[view] + rng.random((len(view), 2)) * (high - low)[view]
    u, v = np.minimum(places.astype(np.int64), size - 1).T
    return view, u, v


@njit(cache=True, nogil=True)
@no_type_check
def _cells_along(first, last, origins, directions, near, far, low_m, cell_m, grid, where, found):
    cells, samples = grid.shape[0], found.shape[1]
    for ray in range(first, last):
        met = far[ray] > near[ray]
        start, span = (near[ray], far[ray] - near[ray]) if met else (0.0, 0.0)
        for i in range(samples):
            depth_m = start + span * ((i + 0.5) / samples)
            for axis in range(3):
                point_m = origins[ray, axis] + depth_m * directions[ray, axis]
                cell = (point_m - low_m[axis]) / cell_m[axis]
                where[ray, i, axis] = int(min(max(cell, 0.0), cells - 1.0))
            x, y, z = where[ray, i]
            found[ray, i] = grid[x, y, z] if met else NEVER


@njit(cache=True, nogil=True)
@no_type_check
def _near_outline(first, last, view, u, v, image_size, boxes_px, table, starts, near):
    """True where some but not all pixels of the square around a pixel are the object's own."""
    height, width = image_size
    for i in range(first, last):
        x1, x2 = max(u[i] - NEAR_OUTLINE_PX, 0), min(u[i] + NEAR_OUTLINE_PX + 1, width)
        y1, y2 = max(v[i] - NEAR_OUTLINE_PX, 0), min(v[i] + NEAR_OUTLINE_PX + 1, height)
        own = own_in(boxes_px[view[i]], table, starts[view[i]], x1, y1, x2, y2)
        near[i] = 0 < own < (x2 - x1) * (y2 - y1)
