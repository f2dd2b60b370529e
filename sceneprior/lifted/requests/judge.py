"""Places that a requested room allows: what stands where, checked for each candidate place."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int

from sceneprior.lifted.requests.relations import FRONTS
from sceneprior.lifted.requests.shape import RoomShape

FLUSH_M = 0.15
"""Gap up to which a back counts as standing at a side of a rectangle in the floor."""
WALL_M = 0.3
"""Largest distance of such a back's middle from a real wall."""


class Candidates(NamedTuple):
    """Candidate places of one object in one particle."""

    boxes_m: Float[np.ndarray, "candidates 6"]
    """Centre and full extents."""
    back: Int[np.ndarray, " candidates"]
    """Side of the back: 0 to 3 for low z, low x, high z, high x."""

    @property
    def footprints(self) -> np.ndarray:
        """Polygons of the footprints."""
        x, _, z, width, _, depth = self.boxes_m.T
        return np.asarray(shapely.box(x - width / 2, z - depth / 2, x + width / 2, z + depth / 2))

    def back_middles_m(self) -> Float[np.ndarray, "candidates 2"]:
        """Middle (x, z) of the edge at the back."""
        half = self.boxes_m[:, [3, 5]] / 2
        return np.asarray(self.boxes_m[:, [0, 2]] - FRONTS[self.back] * half)


def backed_by_walls(
    shape: RoomShape, candidates: Candidates, rectangles_m: Float[np.ndarray, "candidates 4"]
) -> Bool[np.ndarray, " candidates"]:
    """Whether backs that stand at a side of a rectangle in the floor stand at a wall; backs
    elsewhere are free."""
    if shape.is_rectangle:
        return np.ones(len(candidates.back), dtype=bool)
    middles_m = candidates.back_middles_m()
    inward = FRONTS[candidates.back]
    sides_m = rectangles_m[:, :2] - inward * rectangles_m[:, 2:] / 2
    gaps_m = np.abs(((middles_m - sides_m) * inward).sum(axis=1))
    walls = shape.polygon.exterior
    at_wall = shapely.distance(shapely.points(middles_m), walls) <= WALL_M
    return np.asarray((gaps_m > FLUSH_M) | at_wall)


class Standing(NamedTuple):
    """The objects of a particle before the next one is placed."""

    boxes_m: Float[np.ndarray, "objects 6"]
    object_class: Int[np.ndarray, " objects"]
    back: Int[np.ndarray, " objects"]
    coming: Sequence[int]
    """Classes still to come after the next one."""


class Judge:
    """What a requested room allows, from its plan.

    Args:
        shape: Floor, doors, windows and ceiling.
    """

    def __init__(self, shape: RoomShape):
        self.shape = shape

    def allows(
        self,
        label: int,
        candidates: Candidates,
        standing: Standing,
        rectangles_m: Float[np.ndarray, "candidates 4"],
    ) -> tuple[Bool[np.ndarray, " candidates"], str]:
        """Which places an object of a class may take, and what most of the others lack.

        Args:
            rectangles_m: Rectangles in the floor that the places were drawn in.
        """
        allowed = np.ones(len(candidates.back), dtype=bool)
        hurdle = ""
        for name, check in (
            ("a wall behind it", lambda: backed_by_walls(self.shape, candidates, rectangles_m)),
            ("the height of the ceiling", lambda: self._below_ceiling(candidates)),
        ):
            passed = check()
            if (allowed & ~passed).any() and not hurdle:
                hurdle = name
            allowed &= passed
            if not allowed.any():
                break
        return allowed, hurdle

    def _below_ceiling(self, candidates: Candidates) -> Bool[np.ndarray, " candidates"]:
        if self.shape.ceiling_m is None:
            return np.ones(len(candidates.back), dtype=bool)
        tops_m = candidates.boxes_m[:, 1] + candidates.boxes_m[:, 4] / 2
        return np.asarray(tops_m <= self.shape.ceiling_m + 0.01)
