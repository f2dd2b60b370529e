"""Mirror symmetry of shapes: a cell that is empty on one side of a piece is empty on the other.

Most furniture is symmetric, but only some sides of a piece are seen, and the hull is full on the
others.
"""

import numpy as np
from jaxtyping import Bool

ALIKE = 0.75
"""IoU of a shape with its mirror image from which it counts as symmetric."""
SIDES = (0, 2)
"""Axes along which furniture may be symmetric: x and z, not top to bottom."""


def made_symmetric(
    grids: Bool[np.ndarray, "objects x y z"],
) -> Bool[np.ndarray, "objects x y z"]:
    """Shapes without the cells whose mirror images are empty, along each axis along which a shape
    is nearly symmetric.

    A vertical column that would become empty is left unchanged: boxes are not centred to the cell,
    and hulls are accurate in the outline seen from above.
    """
    found = grids.copy()
    for axis in SIDES:
        mirrored = np.flip(found, axis + 1)
        both, either = (part.sum(axis=(1, 2, 3)) for part in (found & mirrored, found | mirrored))
        nearly = both >= ALIKE * either
        found &= mirrored | ~nearly[:, None, None, None]
    lost = grids.any(axis=2, keepdims=True) & ~found.any(axis=2, keepdims=True)
    return found | (grids & lost)
