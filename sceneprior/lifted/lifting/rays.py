"""Rays around an object's masks: each either meets the object or passes through empty space."""

from typing import no_type_check

import numpy as np
from jaxtyping import Int
from numba import njit

from sceneprior.core.cameras import camera_centers
from sceneprior.core.shards import RoomViews
from sceneprior.lifted.lifting.boxes import pixel_directions
from sceneprior.lifted.lifting.hulls import own_in, pass_through, sightings_of
from sceneprior.lifted.lifting.lifted import LiftedBoxes, RayPool
from sceneprior.render.silhouettes.cpu.threads import in_threads

NEAR_OUTLINE_PX = 4
"""Half the width in pixels of the band around a mask's outline from which half of the rays come."""
FAR_M = 100.0
"""Length of rays that no object stops."""


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
