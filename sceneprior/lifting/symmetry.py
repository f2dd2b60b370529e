"""Most furniture is its own mirror image: what one side shows to be air is air on the other.

Only some sides of a piece are seen, and on the others its hull is full.
"""

import numpy as np
from jaxtyping import Bool

ALIKE = 0.75
"""Intersection over union with its mirror image from which on a shape is taken to be symmetric."""
SIDES = (0, 2)
"""Axes along which furniture may be symmetric: not top to bottom."""


def made_symmetric(
    grids: Bool[np.ndarray, "objects x y z"],
) -> Bool[np.ndarray, "objects x y z"]:
    """Shapes without the cells whose mirror images are empty, along each side along which a shape
    is nearly symmetric.

    A column that would vanish stays as it is: boxes are not centred to the cell, and the outline
    from above is what hulls have right.
    """
    found = grids.copy()
    for axis in SIDES:
        mirrored = np.flip(found, axis + 1)
        both, either = (part.sum(axis=(1, 2, 3)) for part in (found & mirrored, found | mirrored))
        nearly = both >= ALIKE * either
        found &= mirrored | ~nearly[:, None, None, None]
    lost = grids.any(axis=2, keepdims=True) & ~found.any(axis=2, keepdims=True)
    return found | (grids & lost)
