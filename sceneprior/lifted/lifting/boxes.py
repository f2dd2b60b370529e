"""Boxes and rays of tracked objects: the smallest 3D box that explains an object's masks in all
views, and rays around the masks, which either meet the object or pass through empty space."""

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int, Real
from numba import njit

from sceneprior.core.cameras import camera_centers, nearest_to_rays, pixel_rays
from sceneprior.core.observations import RoomViews
from sceneprior.lifted.lifting import LiftedBoxes, RayPool
from sceneprior.lifted.lifting.hulls import (
    MOST_EMPTY,
    Sightings,
    carve,
    cells_along,
    own_in,
    pass_through,
    sightings_of,
)
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


def lift_boxes(
    views: RoomViews, chosen: Int[np.ndarray, " views"] | None = None, seed: int = 0
) -> LiftedBoxes:
    """3D boxes of a room's objects, from instance ids and cameras; no 3D ground truth is used.

    An object's visual hull is carved coarse to fine. On each grid, the sides of the box are moved
    inwards one after another, as long as every ray through one of the object's pixels still meets
    a cell of the hull inside the box. The next grid spans only this box, which drops the parts of
    the hull that no ray needs.

    `views` is a room, read with its images, of which only the views `chosen` are used (None: all).
    `seed` chooses the pixels whose rays are used.
    """
    rng = np.random.default_rng(seed)
    rows = np.arange(len(views.visible)) if chosen is None else chosen
    found = [
        _lift(views, rows[views.visible[rows, item]], item, rng)
        for item in range(len(views.object_class))
    ]
    sides_m = np.array([sides for *sides, _ in found]).reshape(-1, 2, 3)
    explained = np.array([share for *_, share in found])
    return LiftedBoxes(sides_m.mean(axis=1), sides_m[:, 1] - sides_m[:, 0], explained)


def _lift(
    views: RoomViews, rows: Int[np.ndarray, " views"], item: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, float]:
    if not len(rows):
        return np.full(3, -0.5), np.full(3, 0.5), 0.0
    poses, intrinsics = views.world_to_camera[rows], views.intrinsics[rows]
    seen = sightings_of(views, rows, item)
    origins_m, directions = own_rays(seen, poses, intrinsics, views.sides_clear[rows, item], rng)
    low_m, high_m = _where_to_look(views, rows, item)
    for cells, reach in GRIDS:
        hull = carve(seen, low_m, high_m, cells, reach)
        where, emptiness = cells_along(hull, origins_m, directions, 3 * cells)
        in_hull = emptiness <= _limit(emptiness.min(axis=1))
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


def _limit(least: Float[np.ndarray, " rays"]) -> float:
    """The emptiness threshold at which a hull meets the share `EXPLAINED` of the rays; `least` is
    each ray's lowest emptiness."""
    met = least[least <= 1]
    return min(float(np.quantile(met, EXPLAINED)), MOST_EMPTY) if len(met) else MOST_EMPTY


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
    seen: Sightings,
    poses: Float[np.ndarray, "views 4 4"],
    intrinsics: Float[np.ndarray, "views 3 3"],
    sides_clear: Bool[np.ndarray, "views 4"],
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "rays 3"], Float[np.ndarray, "rays 3"]]:
    """Origins and unit directions of rays through an object's pixels.

    About `RAYS` of them go through random pixels of the object's masks. In every view, further rays
    go through the outermost pixel at each side where the object itself ends, rather than where an
    occluder cuts it off; these rays determine the object's extent.
    """
    each = max(4, RAYS // len(poses))
    origins, directions = [], []
    for ids, (x1, y1, x2, y2), pose, camera, clear in zip(
        seen.ids, seen.boxes_px, poses, intrinsics, sides_clear, strict=True
    ):
        v, u = np.nonzero(ids[y1:y2, x1:x2] == seen.own_id)
        v, u = v + y1, u + x1
        outermost = np.array([u.argmin(), v.argmin(), u.argmax(), v.argmax()])[clear]
        picked = np.concatenate([rng.integers(len(u), size=each), outermost])
        rays = pixel_directions(u[picked], v[picked], pose, camera)
        directions.append(rays)
        origins.append(np.broadcast_to(camera_centers(pose), rays.shape))
    return np.concatenate(origins).astype(np.float64), np.concatenate(directions)


def pixel_directions(
    u: Real[np.ndarray, " rays"],
    v: Real[np.ndarray, " rays"],
    world_to_camera: Float[np.ndarray, "4 4"],
    intrinsics: Float[np.ndarray, "3 3"],
) -> Float[np.ndarray, "rays 3"]:
    """Unit directions, in the room frame, of rays through the centres of pixels."""
    rays = pixel_rays(np.stack([u, v], axis=-1) + 0.5, world_to_camera, intrinsics)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def _where_to_look(
    views: RoomViews, rows: Int[np.ndarray, " views"], item: int
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Lower and upper corner of a cube that contains the object. Its centre is the point nearest to
    the rays through the centres of the object's 2D boxes."""
    height, width = views.image_size
    boxes_px = views.boxes[rows, item] * np.array([width, height, width, height])
    poses, intrinsics = views.world_to_camera[rows], views.intrinsics[rows]
    middle_px = (boxes_px[:, :2] + boxes_px[:, 2:]) / 2 - 0.5
    cameras_m = camera_centers(poses)
    rays = np.concatenate(
        [
            pixel_directions(pixel[:1], pixel[1:], pose, camera)
            for pixel, pose, camera in zip(middle_px, poses, intrinsics, strict=True)
        ]
    )
    guess_m = (cameras_m + UNKNOWN_DISTANCE_M * rays).mean(axis=0)
    middle_m = nearest_to_rays(cameras_m, rays, 1e-3, guess_m)
    spans = (boxes_px[:, 2:] - boxes_px[:, :2]) / intrinsics[:, [0, 1], [0, 1]]
    distances_m = np.linalg.norm(middle_m - cameras_m, axis=-1)
    radius_m = 1.3 * float((np.linalg.norm(spans, axis=-1) / 2 * distances_m).max()) + 0.15
    return middle_m - radius_m, middle_m + radius_m


def draw_rays(
    views: RoomViews,
    boxes: LiftedBoxes,
    count: int,
    margin: float,
    chosen: Int[np.ndarray, " views"] | None = None,
    seed: int = 0,
) -> RayPool:
    """`count` rays per object, through pixels in and around its mask in every view that shows it.

    A pixel of another object shows that the ray is empty up to that object's box; beyond it, this
    object may be hidden. If the other box is unknown, or the pixel is void, the ray carries no
    information. Walls, floor and everything without an id count as background.

    `margin` is the extent of an object's frame, relative to its box; the other arguments are those
    of `lift_boxes` and its result.
    """
    rng = np.random.default_rng([seed, 1])
    rows = np.arange(len(views.visible)) if chosen is None else chosen
    pools = [
        _draw(views, boxes, rows[views.visible[rows, item]], item, count, margin, rng)
        for item in range(len(views.object_class))
    ]
    if not pools:
        many = np.zeros((0, count, 3), np.float32)
        return RayPool(many, many, many[..., 0] > 0)
    return RayPool(*(np.stack(part) for part in zip(*pools, strict=True)))


def _draw(
    views: RoomViews,
    boxes: LiftedBoxes,
    rows: Int[np.ndarray, " views"],
    item: int,
    count: int,
    margin: float,
    rng: np.random.Generator,
) -> RayPool:
    nowhere = np.zeros((count, 3), np.float32)
    nothing = RayPool(nowhere, nowhere, np.zeros(count, bool))
    if not len(rows):
        return nothing
    poses, intrinsics = views.world_to_camera[rows], views.intrinsics[rows]
    seen = sightings_of(views, rows, item)
    view, u, v = _pixels_round(views, rows, item, 6 * count, rng)
    ids = seen.ids[view, v, u].astype(np.int64)
    directions = np.empty((len(u), 3))
    for row, (pose, camera) in enumerate(zip(poses, intrinsics, strict=True)):
        mine = view == row
        directions[mine] = pixel_directions(u[mine], v[mine], pose, camera)
    origins_m = camera_centers(poses)[view].astype(np.float64)
    until_m = np.where((ids == 0) | (ids == item + 1), FAR_M, 0.0)
    # Indexed by id: True for other objects with a known box. Id 0 is background, the last id void.
    has_box = np.concatenate([[False], boxes.explained > 0, [False]])
    has_box[item + 1] = False
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
        return nothing
    near_outline = np.empty(len(useful), bool)
    in_threads(
        _near_outline, len(useful), view[useful], u[useful], v[useful], views.image_size,
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
        ids[drawn] == item + 1,
    )


def _pixels_round(
    views: RoomViews,
    rows: Int[np.ndarray, " views"],
    item: int,
    count: int,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """View, column and row of random pixels in the object's 2D boxes, widened by a sixth and 8
    pixels."""
    height, width = views.image_size
    size = np.array([width, height])
    boxes_px = views.boxes[rows, item].reshape(-1, 2, 2) * size
    wider = 8 + (boxes_px[:, 1] - boxes_px[:, 0]) / 6
    low = (boxes_px[:, 0] - wider).clip(0)
    high = np.minimum(boxes_px[:, 1] + wider, size)
    view = np.repeat(np.arange(len(rows)), -(-count // len(rows)))
    places = low[view] + rng.random((len(view), 2)) * (high - low)[view]
    u, v = np.minimum(places.astype(np.int64), size - 1).T
    return view, u, v


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
