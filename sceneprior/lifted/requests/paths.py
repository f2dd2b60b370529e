"""Paths through a furnished room, from each door to the furniture."""

from collections.abc import Sequence

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int

from sceneprior.lifted.requests.openings import inward_of
from sceneprior.lifted.requests.shape import RoomShape

PATH_M = 0.6
"""Width of a path."""
CELL_M = 0.05
"""Edge length of the grid's cells."""
HEAD_M = 1.8
"""Objects whose bottom is higher than this are no obstacles."""
FLAT_M = 0.05
"""Objects up to this height, such as rugs, are no obstacles."""
ARM_M = 0.1
"""Largest gap between a path and an object that it reaches."""
FLOOR_M = 0.3
"""Largest height of the bottom of objects that must be reached, which are those on the floor."""


class Paths:
    """Grid of the points where the middle of a path of width `PATH_M` may lie.

    Args:
        shape: A room. In a room without doors, every object counts as reached.
    """

    def __init__(self, shape: RoomShape):
        low_x, low_z, high_x, high_z = shape.polygon.bounds
        self.low_m = np.array([low_x, low_z])
        x, z = (np.arange(a + CELL_M / 2, b, CELL_M) for a, b in ((low_x, high_x), (low_z, high_z)))
        # A little less than half of the path, since cells are sampled at their centres.
        inner = shape.polygon.buffer(-PATH_M / 2 + CELL_M / 2 - 1e-6, join_style="mitre")
        shapely.prepare(inner)
        self.floor: Bool[np.ndarray, "x z"] = shapely.contains_xy(inner, x[:, None], z[None])
        self.starts: list[Int[np.ndarray, 2]] = []
        for each in shape.openings:
            if each.kind == "door":
                middle = np.mean([each.start_m, each.end_m], axis=0)
                inside = middle + (PATH_M / 2 + CELL_M / 2) * inward_of(shape, each)
                self.starts.append(((inside - self.low_m) / CELL_M).astype(int))

    def reached(
        self, boxes_m: Float[np.ndarray, "objects 6"], needs_access: Bool[np.ndarray, " objects"]
    ) -> Bool[np.ndarray, " objects"]:
        """True for objects to which paths lead from all doors, with all boxes as obstacles, and for
        objects that need no path.

        Args:
            needs_access: True for objects that must be reached if they stand on the floor.
        """
        bottoms = boxes_m[:, 1] - boxes_m[:, 4] / 2
        needed = needs_access & (bottoms <= FLOOR_M) & (boxes_m[:, 4] > FLAT_M)
        found = np.ones(len(boxes_m), dtype=bool)
        if not self.starts or not needed.any():
            return found
        from scipy import ndimage

        free = self.floor.copy()
        obstacles = (bottoms < HEAD_M) & (boxes_m[:, 4] > FLAT_M)
        for row in np.flatnonzero(obstacles):
            free[self._cells(boxes_m[row], PATH_M / 2 - CELL_M / 2)] = False
        areas, _ = ndimage.label(free)
        for x, z in self.starts:
            area = areas[max(x - 2, 0) : x + 3, max(z - 2, 0) : z + 3]
            own = np.unique(area[area > 0])
            walked = np.isin(areas, own)
            for row in np.flatnonzero(needed & found):
                found[row] = walked[self._cells(boxes_m[row], PATH_M / 2 + ARM_M)].any()
        return found

    def _cells(self, box_m: Float[np.ndarray, "6"], margin_m: float) -> tuple[slice, slice]:
        """The cells of a footprint, with a margin around it."""
        half = box_m[[3, 5]] / 2 + margin_m
        low = np.round((box_m[[0, 2]] - half - self.low_m) / CELL_M).astype(int).clip(min=0)
        high = np.round((box_m[[0, 2]] + half - self.low_m) / CELL_M).astype(int).clip(min=0)
        return slice(low[0], high[0]), slice(low[1], high[1])


def needs_access(labels: Sequence[str]) -> Bool[np.ndarray, " labels"]:
    """True for classes that must be reachable: all but lamps and plants."""
    return np.array([not any(word in label for word in ("lamp", "plant")) for label in labels])
