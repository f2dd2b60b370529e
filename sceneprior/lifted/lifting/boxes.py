"""Finds the smallest 3D box of each tracked object that explains its masks in all views."""

import numpy as np
from jaxtyping import Bool, Float, Int, Real

from sceneprior.core.cameras import camera_centers, nearest_to_rays, pixel_rays
from sceneprior.core.shards import RoomViews
from sceneprior.lifted.lifting.hulls import MOST_EMPTY, Sightings, carve, cells_along, sightings_of
from sceneprior.lifted.lifting.lifted import LiftedBoxes

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
    for ids, pose, camera, clear in zip(seen.ids, poses, intrinsics, sides_clear, strict=True):
        v, u = np.nonzero(ids == seen.own_id)
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
