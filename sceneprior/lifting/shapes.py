"""What each tracked object may fill of its box, as far as its masks tell; and the space of shapes
that those of a data set span."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import linalg

from sceneprior.lifting.boxes import LiftedBoxes
from sceneprior.lifting.hulls import carve, sightings_of
from sceneprior.shards import RoomViews

REACH = 0.4
"""As `hulls.carve` takes it: parts this thin, in cells, are kept."""
EMPTY = 0.05
"""A cell that more than this share of the views sees past is empty. Less than what `boxes.py`
forgives: there, one wrong cell moves a side; here, it is one cell."""


class ShapeGrid(NamedTuple):
    """How shapes are described."""

    cells: int
    """Along each axis of a grid."""
    margin: float
    """A grid fills the object's box times this."""
    codes: int
    """Dimensions of the shape space; 0 for shapes alone."""


def lift_shapes(
    views: RoomViews,
    boxes: LiftedBoxes,
    shape: ShapeGrid,
    chosen: Int[np.ndarray, " views"] | None = None,
) -> Bool[np.ndarray, "objects x y z"]:
    """The visual hull of each of a room's objects, on a grid in the frame of its box.

    Args:
        views: A room, read with its images.
        boxes: What `lift_boxes` says of it.
        shape: The grids.
        chosen: The views to take; None takes all.

    Returns:
        True where the object may be, indexed x, y, z; nowhere for an object without a box. What
        lies outside of the box is outside of the object.
    """
    rows = np.arange(len(views.visible)) if chosen is None else chosen
    cells, margin = shape.cells, shape.margin
    grids = np.zeros((len(views.object_class), cells, cells, cells), dtype=bool)
    # Cells whose centres lie in the box.
    inside = np.abs((np.arange(cells) + 0.5) / cells - 0.5) * margin < 0.5
    for item in np.flatnonzero(boxes.explained > 0):
        seen = sightings_of(views, rows[views.visible[rows, item]], int(item))
        half_m = margin * boxes.sizes_m[item] / 2
        low_m, high_m = boxes.centers_m[item] - half_m, boxes.centers_m[item] + half_m
        hull = carve(seen, low_m, high_m, cells, REACH, EMPTY)
        grids[item] = (hull.emptiness <= EMPTY) & inside & inside[:, None] & inside[:, None, None]
    return grids


class ShapeSpace(NamedTuple):
    """Grids as a mean plus a weighted sum of orthonormal ones: their principal components."""

    mean: Float[np.ndarray, "x y z"]
    basis: Float[np.ndarray, "codes x y z"]
    spread: float
    """Root mean square of the weights, over shapes and components."""

    def codes_of(
        self, grids: Bool[np.ndarray, "shapes x y z"]
    ) -> Float[np.ndarray, "shapes codes"]:
        """The weights that come nearest to grids. Distances between them are those between the
        grids, summed over cells, but for what the components leave out."""
        flat = self.basis.reshape(len(self.basis), self.mean.size)
        parts = np.array_split(grids, max(1, len(grids) // 256))  # as floats 32 times as large
        codes = [(part - self.mean).reshape(len(part), flat.shape[1]) @ flat.T for part in parts]
        return np.concatenate(codes).astype(np.float32)


def shape_space(grids: Bool[np.ndarray, "shapes x y z"], codes: int) -> ShapeSpace:
    """The first principal components of shapes; zeros for those that fewer shapes do not have.

    Source:
        Leventon et al., "Statistical Shape Influence in Geodesic Active Contours", CVPR 2000, who
        take components of distance fields.
    """
    mean = np.zeros(grids.shape[1:], np.float32)
    basis = np.zeros((codes, *grids.shape[1:]), np.float32)
    found = min(codes, len(grids) - 1)
    if len(grids):
        mean[:] = grids.mean(axis=0)
    if found < 1:
        return ShapeSpace(mean, basis, 1.0)
    apart = (grids - mean).reshape(len(grids), -1)
    # The products of shapes have the singular values of the shapes, squared, and there are far
    # fewer shapes than cells.
    products = (apart @ apart.T).astype(np.float64)
    squares, turns = linalg.eigh(products, subset_by_index=(len(grids) - found, len(grids) - 1))
    kept = squares[::-1] > 1e-6 * squares[-1]  # what is less is rounding
    squares, turns = squares[::-1][kept], turns[:, ::-1][:, kept]
    weights = (turns / np.sqrt(squares)).astype(np.float32)
    basis[: len(squares)] = (weights.T @ apart).reshape(-1, *grids.shape[1:])
    return ShapeSpace(mean, basis, float(np.sqrt(squares.sum() / (len(grids) * found))) or 1.0)
