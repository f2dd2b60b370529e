"""The corners and edges of axis-aligned boxes, in numpy and in torch."""

from itertools import product
from typing import Any, TypeVar

import numpy as np

Array = TypeVar("Array", bound=Any)
"""An array of numpy or a tensor: who prepares data does without torch."""

CUBE_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))
"""(8, 3) corners of the cube [-1, 1]^3; x changes slowest, z fastest."""
BOX_EDGES = tuple((a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit)
"""The 12 edges as pairs of rows of `CUBE_CORNERS`."""


def box_corners(centers_m: Array, sizes_m: Array) -> Array:
    """(..., 8, 3) corners of boxes with (..., 3) centres and full extents, as `CUBE_CORNERS`."""
    half = sizes_m[..., None, :] / 2
    signs = CUBE_CORNERS if isinstance(half, np.ndarray) else half.new_tensor(CUBE_CORNERS)
    return centers_m[..., None, :] + signs * half
