"""Finds the floor of a room that nobody measured: below the lowest pieces that cameras tracked.

Each piece is a box that stands upright, fitted to its 2D boxes in all views; the floor is where the
lowest of them end. Nothing else is taken from these boxes.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from sceneprior.instances.observations import Observations

_VIEWS_AT_MOST = 10
"""Of a piece; more only take longer."""
_VIEWS_AT_LEAST = 3
_PARALLAX_RAD = np.radians(10)
"""Between two views of a piece at least, or its distance is a guess."""
_MISFIT_SHARE = 0.01
"""Mean distance between a box and its 2D boxes, of the image's longer side, above which its lower
end is not believed."""
_AGREE_M = 0.1
"""Pieces whose lower ends are this near to each other stand on the same floor."""
_NEAR_M = 0.05
_BITS = ((np.arange(8)[:, None] >> np.arange(3)) & 1) - 0.5


@dataclass(frozen=True)
class FoundFloor:
    """Where the floor is, and what says so."""

    height_m: float
    """Along the up axis of the cameras' world."""
    pieces: int
    """How many end there."""


def find_floor(
    seen: Observations, world_to_camera: np.ndarray, intrinsics: np.ndarray
) -> FoundFloor | None:
    """The height at which the lowest pieces end; None where fewer than two pieces agree.

    Args:
        seen: What the views show; boxes relative to the image.
        world_to_camera: (views, 4, 4), OpenCV axes, metres; the world's y points up.
        intrinsics: (views, 3, 3) in pixels.
    """
    ends = [
        end
        for piece in range(len(seen.object_class))
        if (end := _lower_end(seen, piece, world_to_camera, intrinsics)) is not None
    ]
    for end in sorted(ends):
        same = [other for other in ends if 0 <= other - end <= _AGREE_M]
        if len(same) >= max(2, len(ends) / 4):  # a single one may be a rug's, or wrong
            return FoundFloor(float(np.median(same)), len(same))
    return None


def _lower_end(
    seen: Observations, piece: int, world_to_camera: np.ndarray, intrinsics: np.ndarray
) -> float | None:
    """The height of a piece's lower side, in the world's y; None where views do not tell."""
    height, width = seen.instance_ids.shape[1:]
    # A side at the image's rim is no side of the piece.
    within = np.abs(seen.boxes[:, piece] - 0.5) < 0.5 - 1.5 / np.array([width, height] * 2)
    clear = seen.sides_clear[:, piece] & within & seen.visible[:, piece, None]
    # The views that show most of its sides.
    views = np.argsort(-clear.sum(axis=1), kind="stable")[:_VIEWS_AT_MOST]
    views = views[seen.visible[views, piece]]
    boxes, clear = seen.boxes[views, piece].astype(np.float64), clear[views]
    if len(views) < _VIEWS_AT_LEAST or clear[:, 3].sum() < 2:
        return None
    boxes *= [width, height, width, height]
    poses, lenses = world_to_camera[views].astype(np.float64), intrinsics[views].astype(np.float64)
    eyes, rays = _rays((boxes[:, :2] + boxes[:, 2:]) / 2, poses, lenses)
    if (rays @ rays.T).min() > np.cos(_PARALLAX_RAD):
        return None
    # The point nearest to all rays.
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    center = np.linalg.solve(across.sum(axis=0), (across @ eyes[:, :, None]).sum(axis=0)[:, 0])
    depth = (poses[:, 2, :3] @ center) + poses[:, 2, 3]
    if (depth < _NEAR_M).any():
        return None
    sizes = (boxes[:, 2:] - boxes[:, :2]) * depth[:, None] / lenses[:, [0, 1], [0, 1]]
    wide, tall = np.median(sizes, axis=0)
    for yaw in (0.0, np.pi / 4):  # a valley each
        start = np.array([*center, *np.log([wide, tall, wide]), yaw])
        given = boxes, clear, poses, lenses
        fit = least_squares(_misfits, start, args=given, loss="soft_l1", max_nfev=40)
        misfit = np.abs(_misfits(fit.x, *given).reshape(-1, 4)[clear]).mean()
        if misfit < _MISFIT_SHARE * max(width, height):
            return float(fit.x[1] - np.exp(fit.x[4]) / 2)
    return None


def _rays(
    pixels: np.ndarray, poses: np.ndarray, lenses: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) eyes, and (n, 3) unit directions of the rays through a pixel of each view."""
    directions = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)
    directions = np.linalg.solve(lenses, directions[:, :, None])
    turns = poses[:, :3, :3].transpose(0, 2, 1)
    rays = (turns @ directions)[:, :, 0]
    eyes = -(turns @ poses[:, :3, 3:])[:, :, 0]
    return eyes, rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _misfits(
    box: np.ndarray, boxes: np.ndarray, clear: np.ndarray, poses: np.ndarray, lenses: np.ndarray
) -> np.ndarray:
    """Pixels between each side of a projected box (centre, logarithms of sizes, yaw) and of its 2D
    box; where something may hide a side, or the image ends, only what sticks out of it counts."""
    turn = Rotation.from_rotvec([0.0, box[6], 0.0]).as_matrix()
    corners = (_BITS * np.exp(np.clip(box[3:6], -5, 3))) @ turn.T + box[:3]
    points = corners @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
    points[..., 2] = np.maximum(points[..., 2], _NEAR_M)
    pixels = (points @ lenses.transpose(0, 2, 1))[..., :2] / points[..., 2:]
    found = np.concatenate([pixels.min(axis=1), pixels.max(axis=1)], axis=1)
    off = found - boxes
    # Of a hidden side the mask shows less than there is: the box may only be larger.
    short = np.concatenate([np.maximum(off[:, :2], 0), np.minimum(off[:, 2:], 0)], axis=1)
    return np.where(clear, off, short).ravel()
