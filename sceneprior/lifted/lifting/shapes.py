"""Visual hulls of tracked objects, on a grid in the frame of each object's box."""

import numpy as np
from jaxtyping import Bool, Int

from sceneprior.core.shards import RoomViews
from sceneprior.lifted.lifting.hulls import carve, sightings_of
from sceneprior.lifted.lifting.lifted import LiftedBoxes, ShapeGrid

REACH = 0.4
"""`reach` of `hulls.carve`, in cells: parts of this thickness are kept."""
EMPTY = 0.05
"""Threshold: a cell counts as empty if a larger share of the views sees past it. The threshold in
`boxes.py` is higher, because there one wrong cell can move a whole side of a box."""


def lift_shapes(
    views: RoomViews,
    boxes: LiftedBoxes,
    shape: ShapeGrid,
    chosen: Int[np.ndarray, " views"] | None = None,
) -> Bool[np.ndarray, "objects x y z"]:
    """The visual hull of each of a room's objects, on a grid in the frame of its box.

    True in cells that the object may fill, never outside the box; all False for an object without
    a box. `views` and `chosen` are those of `lift_boxes`.
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
