"""What lifting finds and how shapes are described, apart from the Numba code that finds it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class LiftedBoxes(NamedTuple):
    """Axis-aligned boxes in the room frame, one a tracked object."""

    centers_m: Float[np.ndarray, "objects 3"]
    sizes_m: Float[np.ndarray, "objects 3"]
    explained: Float[np.ndarray, " objects"]
    """Share of an object's rays that meet its box; 0 where fewer than two views show it, which tell
    nothing of its distance: such boxes mean nothing."""


class ShapeGrid(NamedTuple):
    """How shapes are described."""

    cells: int
    """Along each axis of a grid."""
    margin: float
    """A grid fills the object's box times this."""
