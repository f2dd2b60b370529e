"""Corners, edges and faces of axis-aligned boxes, for numpy and torch."""

from itertools import product
from typing import Any, TypeVar

import numpy as np

Array = TypeVar("Array", bound=Any)
"""A numpy array or a torch tensor; data preparation does not need torch."""

CUBE_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))
"""(8, 3) corners of the cube [-1, 1]^3; x changes slowest, z fastest."""
BOX_EDGES = tuple((a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit)
"""The 12 edges as pairs of indices into `CUBE_CORNERS`."""
BOX_FACES = np.array(
    [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]
)  # fmt: skip
"""12 outward-facing triangles as indices into `CUBE_CORNERS`."""


def box_corners(centers_m: Array, sizes_m: Array) -> Array:
    """Corners of boxes, (..., 8, 3), in the order of `CUBE_CORNERS`.

    Centres and full extents are (..., 3).
    """
    half = sizes_m[..., None, :] / 2
    signs = CUBE_CORNERS if isinstance(half, np.ndarray) else half.new_tensor(CUBE_CORNERS)
    return centers_m[..., None, :] + signs * half
