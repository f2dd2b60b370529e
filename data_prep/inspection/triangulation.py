"""Measures how well cameras fit tracked masks, by triangulating the middles of 2D boxes.

The middle of a 2D box, in u or in v, is taken as the projection of one 3D point of its object, if
nothing cuts the box off along that axis. With the right cameras, these points exist and lie in
front of the cameras. No ground truth is needed, and many hypotheses about the cameras are compared
at once.
"""

from typing import NamedTuple

import numpy as np

from data_prep.readers.upright import own_sides
from sceneprior.core.cameras import camera_centers
from sceneprior.core.shards import RoomViews

TOLERANCE, OF_BOX = 0.01, 0.15
"""Distance at which the agreement of a middle is one half: a share of the longer side of the image,
plus a share of the 2D box, whose middle is not exactly the projection of a fixed point."""
_MIDDLES_AT_MOST = 60
"""Maximum number of middles per object, thinned evenly; more only take longer."""
_MIDDLES_AT_LEAST = 5
"""Minimum number of middles per object; three determine a point."""
_ROUNDS = 6
_NEAR_M = 0.05


class Middles(NamedTuple):
    """The m middles of a room's 2D boxes, sorted by object."""

    view: np.ndarray
    """(m,)"""
    item: np.ndarray
    """(m,) number of the object, from 0 without gaps; not its index in the room."""
    axis: np.ndarray
    """(m,) 0 for u, 1 for v."""
    place_px: np.ndarray
    """(m,)"""
    extent_px: np.ndarray
    """(m,) size of the 2D box along this axis."""
    slack_px: np.ndarray
    """(m,) distance at which the agreement is one half."""

    @property
    def spare(self) -> int:
        """Number of middles beyond the three that determine each object's point."""
        return len(self.item) - 3 * len(np.unique(self.item))


def middles(views: RoomViews) -> Middles:
    """Find the middles of 2D boxes that nothing cuts off, for objects with enough middles."""
    height, width = views.image_size
    own = own_sides(views, views.image_size)
    boxes = views.boxes.astype(np.float64) * [width, height, width, height]
    rows: list[tuple[int, int, int]] = []
    for k in range(boxes.shape[1]):
        own_rows = [
            (int(view), k, axis)
            for view in range(len(boxes))
            for axis in (0, 1)
            if own[view, k, axis] and own[view, k, axis + 2]
        ]
        if len(own_rows) >= _MIDDLES_AT_LEAST:
            places = np.linspace(0, len(own_rows) - 1, min(len(own_rows), _MIDDLES_AT_MOST))
            rows += [own_rows[round(place)] for place in places]
    view, item, axis = np.array(rows, dtype=np.int64).reshape(-1, 3).T
    low, high = boxes[view, item, axis], boxes[view, item, axis + 2]
    slack = TOLERANCE * max(height, width) + OF_BOX * (high - low)
    number = np.unique(item, return_inverse=True)[1]
    return Middles(view, number, axis, (low + high) / 2, high - low, slack)


def fit(
    found: Middles, world_to_camera: np.ndarray, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Agreement of each middle with each of h hypotheses about the cameras, and its depth.

    The agreement is 1 / (1 + (r / slack)^2) for the distance r in pixels from the middle to the
    object's projected point, which is a robust least-squares solution. r is divided by one minus
    the middle's leverage, and so approximates the distance to the point that the other middles
    determine. Points behind the camera score 0.

    Args:
        world_to_camera: (h, T, 4, 4), OpenCV axes; the world frame and its unit are arbitrary.
        intrinsics: (h, T, 3, 3)

    Returns:
        The agreement in [0, 1], (h, m), and the depth of each middle's object point, (h, m), in the
        unit of the poses.
    """
    if not len(found.item):
        none = np.zeros((len(world_to_camera), 0))
        return none, none
    rows = np.arange(len(found.item))
    starts = np.flatnonzero(np.diff(found.item, prepend=-1))
    scaled, unit = _unit_of_length(world_to_camera)
    poses = scaled[:, found.view, :3]
    focal = intrinsics[:, found.view, found.axis, found.axis]
    center = intrinsics[:, found.view, found.axis, 2]
    # A middle and the camera's axis span a plane, `planes @ (x, y, z, 1) = 0`, that contains the
    # point.
    planes = focal[..., None] * poses[:, rows, found.axis]
    planes = planes + (center - found.place_px)[..., None] * poses[:, :, 2]
    weight = 1 / np.abs(focal)
    for _ in range(_ROUNDS):
        weighted = planes * weight[..., None]
        products = weighted[..., :3, None] * weighted[..., None, :]
        sums = np.add.reduceat(products, starts, axis=1)
        square = sums[..., :3]
        loose = 1e-9 * np.trace(square, axis1=-2, axis2=-1) + 1e-12
        square = square + loose[..., None, None] * np.eye(3)
        points = np.linalg.solve(square, -sums[..., 3:])[..., 0][:, found.item]
        depth = (poses[:, :, 2, :3] * points).sum(axis=-1) + poses[:, :, 2, 3]
        far = np.maximum(np.abs(depth), _NEAR_M)
        off = ((planes[..., :3] * points).sum(axis=-1) + planes[..., 3]) / far
        weight = 1 / (far * found.slack_px * np.sqrt(1 + (off / found.slack_px) ** 2))
    inverse, weighted = np.linalg.inv(square)[:, found.item], weighted[..., :3]
    leverage = np.einsum("hmi,hmij,hmj->hm", weighted, inverse, weighted)
    off = off / np.maximum(1 - leverage, 1e-3)
    agreement = np.where(depth > _NEAR_M, 1 / (1 + (off / found.slack_px) ** 2), 0.0)
    return agreement, depth * unit[:, None]


def _unit_of_length(world_to_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses moved and scaled so that cameras stand about 2 m from the origin, their middle; and the
    unit of length, (h,)."""
    turns = world_to_camera[..., :3, :3]
    eyes = camera_centers(world_to_camera)
    middle = eyes.mean(axis=1, keepdims=True)
    unit = np.sqrt(((eyes - middle) ** 2).sum(axis=-1).mean(axis=1)) / 2
    unit = np.maximum(unit, 1e-9)
    scaled = world_to_camera.copy()
    moved = world_to_camera[..., :3, 3] + (turns @ middle[..., None])[..., 0]
    scaled[..., :3, 3] = moved / unit[:, None, None]
    return scaled, unit
