"""Results of lifting, and the grid of its shapes; separate from the Numba code that computes
them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


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
