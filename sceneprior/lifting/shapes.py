"""What each tracked object may fill of its box, as far as its masks tell."""

import numpy as np
from jaxtyping import Bool, Int

from sceneprior.lifting.hulls import carve, sightings_of
from sceneprior.lifting.lifted import LiftedBoxes, ShapeGrid
from sceneprior.shards import RoomViews

REACH = 0.4
"""As `hulls.carve` takes it: parts this thin, in cells, are kept."""
EMPTY = 0.05
"""A cell that more than this share of the views sees past is empty. Less than what `boxes.py`
forgives: there, one wrong cell moves a side; here, it is one cell."""


def lift_shapes(
    views: RoomViews,
    boxes: LiftedBoxes,
    shape: ShapeGrid,
    chosen: Int[np.ndarray, " views"] | None = None,
) -> Bool[np.ndarray, "objects x y z"]:
    """The visual hull of each of a room's objects, on a grid in the frame of its box.

    Args:
        views: A room, read with its images.
        boxes: What `lift_boxes` says of it.
        shape: The grids.
        chosen: The views to take; None takes all.

    Returns:
        True where the object may be, indexed x, y, z; nowhere for an object without a box. What
        lies outside of the box is outside of the object.
    """
    rows = np.arange(len(views.visible)) if chosen is None else chosen
    cells, margin = shape.cells, shape.margin
    grids = np.zeros((len(views.object_class), cells, cells, cells), dtype=bool)
    # Cells whose centres lie in the box.
    inside = np.abs((np.arange(cells) + 0.5) / cells - 0.5) * margin < 0.5
    for item in np.flatnonzero(boxes.explained > 0):
        seen = sightings_of(views, rows[views.visible[rows, item]], int(item))
        half_m = margin * boxes.sizes_m[item] / 2
        low_m, high_m = boxes.centers_m[item] - half_m, boxes.centers_m[item] + half_m
        hull = carve(seen, low_m, high_m, cells, REACH, EMPTY)
        grids[item] = (hull.emptiness <= EMPTY) & inside & inside[:, None] & inside[:, None, None]
    return grids
