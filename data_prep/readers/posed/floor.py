"""Estimates the height of an unknown floor from the lowest tracked pieces of furniture.

An upright 3D box is fitted to the 2D boxes of each piece in all views; the floor is at the bottom
of the lowest boxes. The boxes are used for nothing else.
"""

import numpy as np

from data_prep.readers.upright import fit_upright, own_sides
from sceneprior.core.observations import Observations

_MISFIT_SHARE = 0.01
"""Maximum mean distance between a projected box and its 2D boxes, relative to the image's longer
side, for its bottom to be used."""
_AGREE_M = 0.1
"""Maximum height difference between the bottoms of pieces on the same floor."""
_LOWER_SIDES = 2
"""Minimum number of views in which the lower side of a piece is unoccluded."""


def find_floor(
    seen: Observations, world_to_camera: np.ndarray, intrinsics: np.ndarray
) -> tuple[float, int] | None:
    """Find the height at which the lowest pieces end, along y, and the number of these pieces.

    The cameras' world is in metres, and its y points up. None if fewer than two pieces agree.
    """
    height, width = seen.instance_ids.shape[1:]
    corners, misfit_px = fit_upright(seen, (height, width), world_to_camera, intrinsics)
    believed = misfit_px < _MISFIT_SHARE * max(width, height)
    believed &= own_sides(seen, (height, width))[..., 3].sum(axis=0) >= _LOWER_SIDES
    ends = corners[believed, :, 1].min(axis=1).tolist()
    for end in sorted(ends):
        same = [other for other in ends if 0 <= other - end <= _AGREE_M]
        if len(same) >= max(2, len(ends) / 4):  # a single one may be wrong
            return float(np.median(same)), len(same)
    return None
