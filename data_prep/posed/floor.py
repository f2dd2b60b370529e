"""Finds the floor of a room that nobody measured: below the lowest pieces that cameras tracked.

Each piece is a box that stands upright, fitted to its 2D boxes in all views; the floor is where the
lowest of them end. Nothing else is taken from these boxes.
"""

from dataclasses import dataclass

import numpy as np

from data_prep.upright import fit_upright, own_sides
from sceneprior.instances.observations import Observations

_MISFIT_SHARE = 0.01
"""Mean distance between a box and its 2D boxes, of the image's longer side, above which its lower
end is not believed."""
_AGREE_M = 0.1
"""Pieces whose lower ends are this near to each other stand on the same floor."""
_LOWER_SIDES = 2
"""Of a piece, seen clearly, at least."""


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
    height, width = seen.instance_ids.shape[1:]
    boxes = fit_upright(seen, (height, width), world_to_camera, intrinsics)
    believed = boxes.misfit_px < _MISFIT_SHARE * max(width, height)
    believed &= own_sides(seen, (height, width))[..., 3].sum(axis=0) >= _LOWER_SIDES
    ends = (boxes.centers_m[:, 1] - boxes.sizes_m[:, 1] / 2)[believed].tolist()
    for end in sorted(ends):
        same = [other for other in ends if 0 <= other - end <= _AGREE_M]
        if len(same) >= max(2, len(ends) / 4):  # a single one may be a rug's, or wrong
            return FoundFloor(float(np.median(same)), len(same))
    return None
