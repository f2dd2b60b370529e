"""Lifting: 3D boxes and shapes of tracked objects from masks and cameras alone, before any
training. Its results are defined here, apart from the Numba code that computes them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

HANGS_M = 0.3
"""Height of the lower side above which an object counts as hanging; others stand on the floor."""


class LiftedBoxes(NamedTuple):
    """Axis-aligned boxes in the room frame, one per tracked object."""

    centers_m: Float[np.ndarray, "objects 3"]
    sizes_m: Float[np.ndarray, "objects 3"]
    explained: Float[np.ndarray, " objects"]
    """Share of an object's rays that meet its box. 0 if fewer than two views show the object, which
    leaves its distance undetermined: the box is then meaningless."""


class ShapeGrid(NamedTuple):
    """Grid on which shapes are represented."""

    cells: int
    """Cells along each axis."""
    margin: float
    """Extent of the grid, relative to the object's box."""


class RayPool(NamedTuple):
    """Segments of rays in the frames of one or more objects, which span [-1, 1]; the same number of
    rays for each object."""

    starts: Float[np.ndarray, "*objects rays 3"]
    """Points at which the rays enter the frame."""
    spans: Float[np.ndarray, "*objects rays 3"]
    """Vector from the start to the point where the ray leaves the frame, or beyond which nothing is
    known; 0 for a ray without information."""
    hits: Bool[np.ndarray, "*objects rays"]
    """True if the object is met on the segment; otherwise the whole segment is empty."""
