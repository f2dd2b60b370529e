"""Ways through a furnished room: floor on which one can walk from each door to the furniture."""

from collections.abc import Sequence

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int

from sceneprior.lifted.requests.openings import inward_of
from sceneprior.lifted.requests.shape import RoomShape

WAY_M = 0.6
"""Width of a way."""
CELL_M = 0.05
HEAD_M = 1.8
"""Objects whose bottom is higher do not stand in the way."""
FLAT_M = 0.05
"""Objects up to this height, such as rugs, do not either."""
ARM_M = 0.1
"""Gap between the way and an object that counts as reached."""
FLOOR_M = 0.3
"""Largest height of the bottom of objects that must be reached: they stand on the floor."""


class Ways:
    """Grid of the places where the middle of a way of `WAY_M` may lie.

    Args:
        shape: A room; without a door every object counts as reached.
    """

    def __init__(self, shape: RoomShape):
        low_x, low_z, high_x, high_z = shape.polygon.bounds
        self.low_m = np.array([low_x, low_z])
        x, z = (np.arange(a + CELL_M / 2, b, CELL_M) for a, b in ((low_x, high_x), (low_z, high_z)))
        # A little less than half of the way, since cells are sampled at their centres.
        inner = shape.polygon.buffer(-WAY_M / 2 + CELL_M / 2 - 1e-6, join_style="mitre")
        shapely.prepare(inner)
        self.floor: Bool[np.ndarray, "x z"] = shapely.contains_xy(inner, x[:, None], z[None])
        self.starts: list[Int[np.ndarray, 2]] = []
        for each in shape.openings:
            if each.kind == "door":
                middle = np.mean([each.start_m, each.end_m], axis=0)
                inside = middle + (WAY_M / 2 + CELL_M / 2) * inward_of(shape, each)
                self.starts.append(((inside - self.low_m) / CELL_M).astype(int))

    def reached(
        self, boxes_m: Float[np.ndarray, "objects 6"], functional: Bool[np.ndarray, " objects"]
    ) -> Bool[np.ndarray, " objects"]:
        """Which objects a way leads to from every door, among all of the boxes as obstacles; true
        for those that need none.

        Args:
            functional: Classes that one uses where they stand, which lamps are not.
        """
        bottoms = boxes_m[:, 1] - boxes_m[:, 4] / 2
        needed = functional & (bottoms <= FLOOR_M) & (boxes_m[:, 4] > FLAT_M)
        found = np.ones(len(boxes_m), dtype=bool)
        if not self.starts or not needed.any():
            return found
        from scipy import ndimage

        free = self.floor.copy()
        obstacles = (bottoms < HEAD_M) & (boxes_m[:, 4] > FLAT_M)
        for row in np.flatnonzero(obstacles):
            free[self._cells(boxes_m[row], WAY_M / 2 - CELL_M / 2)] = False
        areas, _ = ndimage.label(free)
        for x, z in self.starts:
            area = areas[max(x - 2, 0) : x + 3, max(z - 2, 0) : z + 3]
            own = np.unique(area[area > 0])
            walked = np.isin(areas, own)
            for row in np.flatnonzero(needed & found):
                found[row] = walked[self._cells(boxes_m[row], WAY_M / 2 + ARM_M)].any()
        return found

    def _cells(self, box_m: Float[np.ndarray, "6"], margin_m: float) -> tuple[slice, slice]:
        """The cells of a footprint, with a margin around it."""
        half = box_m[[3, 5]] / 2 + margin_m
        low = np.round((box_m[[0, 2]] - half - self.low_m) / CELL_M).astype(int).clip(min=0)
        high = np.round((box_m[[0, 2]] + half - self.low_m) / CELL_M).astype(int).clip(min=0)
        return slice(low[0], high[0]), slice(low[1], high[1])


def is_functional(labels: Sequence[str]) -> Bool[np.ndarray, " labels"]:
    """Which classes one uses where they stand: all but lamps and plants."""
    return np.array([not any(word in label for word in ("lamp", "plant")) for label in labels])
