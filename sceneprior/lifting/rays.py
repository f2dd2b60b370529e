"""Rays through the masks of an object: each says that it is met, or that a stretch is empty."""

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from sceneprior.lifting.boxes import pixel_directions
from sceneprior.lifting.hulls import own_in, pass_through, sightings_of
from sceneprior.lifting.lifted import LiftedBoxes
from sceneprior.shards import RoomViews
from sceneprior.silhouettes.cpu.threads import in_threads

NEAR_OUTLINE_PX = 4
"""Pixels this near to a mask's outline are drawn as often as all others together."""
FAR_M = 100.0
"""Where rays end that nothing stops."""


class RayPool(NamedTuple):
    """The parts of rays in the frames of a room's objects, as many for each; a frame spans
    [-1, 1]."""

    starts: Float[np.ndarray, "objects rays 3"]
    spans: Float[np.ndarray, "objects rays 3"]
    """From where a ray enters the frame, to where it leaves it or is known no further; 0: none."""
    hits: Bool[np.ndarray, "objects rays"]
    """Whether the object is met on the way; else all is empty."""


def draw_rays(
    views: RoomViews,
    boxes: LiftedBoxes,
    count: int,
    margin: float,
    chosen: Int[np.ndarray, " views"] | None = None,
    seed: int = 0,
) -> RayPool:
    """`count` rays an object, through pixels in and round its mask in every view that shows it.

    A pixel of another object tells that the ray is empty as far as that object's box: it may stand
    in front. Walls, floor and all that has no id are behind everything.

    Args:
        views: A room, read with its images.
        boxes: What `lift_boxes` says of it.
        count: Rays an object.
        margin: An object's frame is its box times this.
        chosen, seed: As for `lift_boxes`.
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
    cameras_m = -(poses[:, :3, :3].transpose(0, 2, 1) @ poses[:, :3, 3:])[..., 0]
    origins_m = cameras_m[view].astype(np.float64)
    until_m = np.full(len(u), FAR_M)
    other = (ids != 0) & (ids != item + 1)
    sizes_m = 1.05 * boxes.sizes_m  # boxes err, too
    entered = entry_m(
        origins_m[other], directions[other],
        boxes.centers_m[ids[other] - 1], sizes_m[ids[other] - 1],
    )  # fmt: skip
    until_m[other] = np.where(np.isfinite(entered), entered, 0)
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
    """View, column and row of pixels in the 2D boxes, widened by a sixth and 8 pixels."""
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
    """Whether some but not all pixels of the square round a pixel are the object's own."""
    height, width = image_size
    for i in range(first, last):
        x1, x2 = max(u[i] - NEAR_OUTLINE_PX, 0), min(u[i] + NEAR_OUTLINE_PX + 1, width)
        y1, y2 = max(v[i] - NEAR_OUTLINE_PX, 0), min(v[i] + NEAR_OUTLINE_PX + 1, height)
        own = own_in(boxes_px[view[i]], table, starts[view[i]], x1, y1, x2, y2)
        near[i] = 0 < own < (x2 - x1) * (y2 - y1)


def entry_m(
    origins_m: Float[np.ndarray, "rays 3"],
    directions: Float[np.ndarray, "rays 3"],
    centers_m: Float[np.ndarray, "*rays 3"],
    sizes_m: Float[np.ndarray, "*rays 3"],
) -> Float[np.ndarray, " rays"]:
    """Where rays enter axis-aligned boxes, 0 from inside; infinite for those that miss."""
    near, far = pass_through(
        origins_m, directions, centers_m - sizes_m / 2, centers_m + sizes_m / 2
    )
    return np.where(far > near, near, np.inf)
