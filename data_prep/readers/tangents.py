"""Epipolar tangency: measures errors of poses and masks from the masks of two views alone.

The planes through the centres of two cameras (epipolar planes) form a pencil. Those that intersect
an object are a range of this pencil, and the two planes at the ends of the range are tangent to the
object. The range is the same in both images, whatever the object's shape; so where the outlines are
the object's own, not cut off by another object or the image border, a difference between the two
ranges is an error of a pose or of a mask (Wong and Cipolla, "Structure and motion from
silhouettes", ICCV 2001).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import ConvexHull

from sceneprior.core.observations import TOUCH_PX, Observations

PAIRS_AT_MOST = 20_000
"""Maximum number of pairs of masks; if there are more, they are thinned evenly."""
_BASELINE_M = 0.1
"""Smallest distance between two cameras."""
_WIDEST_RAD = 1.5
"""Largest angle between the plane through a mask's middle and any other through the mask; it is
larger if one camera stands in front of the object in the other's image."""


class Outlines(NamedTuple):
    """Convex hulls of the masks of one room, and the pairs of masks that show the same object."""

    rays: Float[np.ndarray, "masks corners 3"]
    """Unit vectors through the corners, in the camera's axes; the last one is repeated."""
    clear: Bool[np.ndarray, "masks corners"]
    """True where neither another object nor the image's border touches the corner."""
    view: Int[np.ndarray, " masks"]
    item: Int[np.ndarray, " masks"]
    """Index of the object."""
    focal_px: Float[np.ndarray, " masks"]
    pairs: Int[np.ndarray, "pairs 2"]
    """Indices of masks of the same object in two views."""


class Gaps(NamedTuple):
    """Differences between the ranges of planes of the two masks of each pair, at both ends."""

    gaps_px: Float[np.ndarray, "pairs 2"]
    """Distance of the first mask's end inside the second's, in pixels: negative if the first mask
    is the wider one. The two masks share the error according to how far the end is from the other
    camera in either image."""
    clear: Bool[np.ndarray, "pairs 2 2"]
    """True if the end (second axis) is the object's own in the first and second mask (last
    axis)."""
    slopes: Float[np.ndarray, "pairs 2 12"]
    """Derivatives of `gaps_px` by small turns of the first camera about its centre and by its
    moves, both along the world's axes, then by those of the second camera."""
    widths_px: Float[np.ndarray, "pairs 2"]
    """Widths of the ranges of the first and the second mask."""
    valid: Bool[np.ndarray, " pairs"]
    """False if the cameras are too near to each other, or one stands before the object."""


def find_outlines(seen: Observations, intrinsics: Float[np.ndarray, "views 3 3"]) -> Outlines:
    """Convex hulls of all visible masks; `intrinsics` are in pixels of the images."""
    rays, clear, names = [], [], []
    for view, image in enumerate(seen.instance_ids):
        places = ndimage.find_objects(image)
        for item in np.flatnonzero(seen.visible[view]).tolist():
            corners = hull_corners(image, item + 1, places[item])
            clear.append(_clear_corners(image, item + 1, corners))
            points = np.concatenate([corners, np.ones((len(corners), 1))], axis=1)
            points = points @ np.linalg.inv(intrinsics[view].astype(np.float64)).T
            rays.append(points / np.linalg.norm(points, axis=1, keepdims=True))
            names.append((view, item))
    most = max((len(corners) for corners in rays), default=1)
    of_view, of_item = np.array(names, dtype=np.int64).reshape(-1, 2).T
    pairs = np.argwhere((of_item[:, None] == of_item) & (of_view[:, None] < of_view))
    return Outlines(
        np.stack([np.pad(each, ((0, most - len(each)), (0, 0)), mode="edge") for each in rays]),
        np.stack([np.pad(each, (0, most - len(each)), mode="edge") for each in clear]),
        of_view, of_item, intrinsics[of_view, 0, 0].astype(np.float64),
        pairs[:: max(1, -(-len(pairs) // PAIRS_AT_MOST))],
    )  # fmt: skip


def hull_corners(
    image: np.ndarray, number: int, place: tuple[slice, slice]
) -> Int[np.ndarray, "corners 2"]:
    """Corners x, y of the convex hull of a mask's pixels; `place` are its rows and columns."""
    own = image[place] == number
    y = np.flatnonzero(own.any(axis=1))
    left, right = own[y].argmax(axis=1), own.shape[1] - own[y, ::-1].argmax(axis=1)
    ends = np.concatenate(
        [np.stack([x, y + below], axis=1) for x in (left, right) for below in (0, 1)]
    )
    return ends[ConvexHull(ends).vertices] + [place[1].start, place[0].start]


def _clear_corners(
    image: np.ndarray, number: int, corners: Int[np.ndarray, "corners 2"]
) -> Bool[np.ndarray, " corners"]:
    other = (image != 0) & (image != number)
    inner = ((corners > 1) & (corners < np.array(image.shape[::-1]) - 1)).all(axis=1)
    around = [
        other[max(y - TOUCH_PX, 0) : y + TOUCH_PX, max(x - TOUCH_PX, 0) : x + TOUCH_PX].any()
        for x, y in corners.tolist()
    ]
    return inner & ~np.array(around)


def measure_gaps(
    outlines: Outlines,
    rotations: Float[np.ndarray, "views 3 3"],
    centers_m: Float[np.ndarray, "views 3"],
) -> Gaps:
    """Measure all pairs, with the cameras' axes (rows of world-to-camera rotations) and centres."""
    directions = outlines.rays @ rotations[outlines.view]
    first, second = outlines.pairs.T
    step_m = centers_m[outlines.view[second]] - centers_m[outlines.view[first]]
    length_m = np.maximum(np.linalg.norm(step_m, axis=1), 1e-9)
    axis = step_m / length_m[:, None]
    masks = directions[first], directions[second]
    middle = masks[0].mean(axis=1) + masks[1].mean(axis=1)
    ahead = middle - (middle * axis).sum(axis=1, keepdims=True) * axis
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    aside = np.cross(axis, ahead)

    rows = np.arange(len(first))[:, None]
    ends, turns, px_per_rad, clear, spread = [], [], [], [], []
    for mask, rays in zip((first, second), masks, strict=True):
        x, y = (np.einsum("pci,pi->pc", rays, side) for side in (ahead, aside))
        angle = np.arctan2(y, x)
        spread.append(np.abs(angle).max(axis=1))
        at = np.stack([angle.argmin(axis=1), angle.argmax(axis=1)], axis=1)
        ends.append(angle[rows, at])
        clear.append(outlines.clear[mask[:, None], at])
        away = np.maximum(np.hypot(x, y)[rows, at], 1e-9)
        px_per_rad.append(outlines.focal_px[mask][:, None] * away)
        along = np.einsum("pei,pi->pe", rays[rows, at], axis)[..., None]
        across = rays[rows, at] - along * axis[:, None]
        # The change of the angle with a turn of the camera about each of the world's axes.
        turns.append(axis[:, None] - along * across / away[..., None] ** 2)

    inwards = np.array([1.0, -1.0])
    scale = 1 / np.sqrt(px_per_rad[0] ** -2 + px_per_rad[1] ** -2)
    # A move of a camera turns the axis, as a turn of both cameras the other way would.
    moves = np.cross(turns[0] - turns[1], axis[:, None]) / length_m[:, None, None]
    slopes = np.concatenate([turns[0], moves, -turns[1], -moves], axis=2)
    return Gaps(
        (ends[0] - ends[1]) * scale * inwards,
        np.stack(clear, axis=2),
        slopes * (scale * inwards)[..., None],
        np.stack([np.ptp(end, axis=1) for end in ends], axis=1) * scale.mean(axis=1)[:, None],
        (length_m > _BASELINE_M) & (np.maximum(*spread) < _WIDEST_RAD),
    )
