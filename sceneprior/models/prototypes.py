"""Shapes repeat: a few prototypes, mirrored and turned, stand for all objects of a data set."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sceneprior.geometry.turns import QUARTERS, turn_grids

POSES = 2 * QUARTERS
"""Of a prototype: pose p is mirrored, x reversed, where p is 4 or more, then turned about +y by
p % 4 quarters. A look is a prototype times this, plus a pose."""
ALIKE = 0.25
"""Two objects look alike that are no farther apart than this: the squared difference of their
coarse grids over what these fill (the geometric mean of both), or a chair's legs would count for
nothing, plus `SIZE_WEIGHT` times the sum of how much their extents' logarithms differ."""
SIZE_WEIGHT = 0.3
COMMON = 3
"""A common prototype looks like at least so many objects, itself among them, or is its class's most
common one: an odd shape is more often badly lifted than rare."""
COARSE, PARTS = 8, 4
"""Parts along each axis of the grids that are compared, and of those that the network is shown."""


class Prototypes(NamedTuple):
    """Objects that stand for all others of their classes."""

    grids: Bool[np.ndarray, "prototypes x y z"]
    sizes_m: Float[np.ndarray, "prototypes 3"]
    object_class: Int[np.ndarray, " prototypes"]
    """-1 for one that stands for nothing."""
    common: Bool[np.ndarray, " prototypes"]
    """Whether it stands for several objects (`COMMON`)."""

    def common_alone(self) -> "Prototypes":
        """The same, in the same order, of which those that are not common stand for nothing."""
        return self._replace(object_class=np.where(self.common, self.object_class, -1))

    def shown(self) -> Float[np.ndarray, "looks shown"]:
        """What each look looks like to a network: a coarse grid, and logarithms of the extents."""
        rows = [
            np.hstack([
                turn_grids(pooled(self.grids, PARTS), *turn_of(pose)).reshape(len(self.grids), -1),
                turned_extents(np.log(self.sizes_m), pose),
            ])
            for pose in range(POSES)
        ]  # fmt: skip
        return np.stack(rows, axis=1).reshape(len(self.grids) * POSES, -1).astype(np.float32)

    def looks_of(
        self,
        grids: Bool[np.ndarray, "objects x y z"],
        sizes_m: Float[np.ndarray, "objects 3"],
        object_class: Int[np.ndarray, " objects"],
    ) -> Int[np.ndarray, " objects"]:
        """The look that comes nearest to each object, -1 where its class has none."""
        looks = np.full(len(grids), -1, dtype=np.int64)
        for label in np.unique(object_class):
            rows, own = (
                np.flatnonzero(all_ == label) for all_ in (object_class, self.object_class)
            )
            if len(own):
                ours = described(grids[rows], sizes_m[rows])
                apart, pose = distances(ours, described(self.grids[own], self.sizes_m[own]))
                nearest = apart.argmin(axis=1)
                looks[rows] = own[nearest] * POSES + pose[np.arange(len(rows)), nearest]
        return looks


def choose_prototypes(
    grids: Bool[np.ndarray, "objects x y z"],
    sizes_m: Float[np.ndarray, "objects 3"],
    object_class: Int[np.ndarray, " objects"],
    usable: Bool[np.ndarray, " objects"],
    most: int,
) -> Prototypes:
    """Of each class the objects that look like most others, until every usable one looks like one.

    `ALIKE` is taken half as large again until there are at most `most`, or one a class.
    """
    apart = []
    for label in np.unique(object_class[usable]):
        rows = np.flatnonzero((object_class == label) & usable)
        own = described(grids[rows], sizes_m[rows])
        apart.append((rows, distances(own, own)[0]))
    alike = ALIKE
    items, common = _covering(apart, alike)
    while len(items) > max(most, len(apart)):
        alike *= 1.5
        items, common = _covering(apart, alike)
    return Prototypes(grids[items], sizes_m[items], object_class[items], common)


def _covering(
    apart: list[tuple[np.ndarray, np.ndarray]], alike: float
) -> tuple[Int[np.ndarray, " prototypes"], Bool[np.ndarray, " prototypes"]]:
    """`choose_prototypes` from each class's rows and their distances, and which are common."""
    items, common = [], []
    for rows, distance in apart:
        near = (distance <= alike) | np.eye(len(rows), dtype=bool)
        first = True
        while near.any():
            likes = near.sum(axis=0)
            best = int(likes.argmax())
            items.append(rows[best])
            common.append(first or likes[best] >= COMMON)
            near[near[:, best]] = False  # they are spoken for
            first = False
    return np.array(items, dtype=np.int64), np.array(common, dtype=bool)


def looks_apart(
    grids: Bool[np.ndarray, "prototypes x y z"], codes: int
) -> Float[np.ndarray, "looks codes"]:
    """Codes of all looks, whose squared distances come nearest to the numbers of cells in which
    the looks differ: their principal components; zeros for those that fewer looks do not have.

    Source:
        Torgerson, "Multidimensional scaling: I. Theory and method", Psychometrika 1952.
    """
    from scipy import linalg  # here, since only training finds codes

    looks = np.stack([turn_grids(grids, *turn_of(pose)) for pose in range(POSES)], axis=1)
    flat = looks.reshape(len(grids) * POSES, -1).astype(np.float32)
    flat -= flat.mean(axis=0)
    # The products of looks have their singular values, squared; there are far fewer than cells.
    products = (flat @ flat.T).astype(np.float64)
    found = min(codes, len(flat))
    squares, turns = linalg.eigh(products, subset_by_index=(len(flat) - found, len(flat) - 1))
    placed = np.zeros((len(flat), codes), np.float32)
    placed[:, :found] = turns[:, ::-1] * np.sqrt(squares[::-1].clip(min=0))
    return placed


class Described(NamedTuple):
    """What objects are compared by."""

    coarse: Float[np.ndarray, "objects u v w"]
    log_sizes: Float[np.ndarray, "objects 3"]


def described(
    grids: Bool[np.ndarray, "objects x y z"], sizes_m: Float[np.ndarray, "objects 3"]
) -> Described:
    """Coarse grids and logarithms of extents."""
    return Described(pooled(grids, COARSE), np.log(sizes_m))


def distances(
    objects: Described, offered: Described
) -> tuple[Float[np.ndarray, "objects offered"], Int[np.ndarray, "objects offered"]]:
    """How far each object is from each offered one in its best pose, and which that is; the first
    of equal ones."""
    own, theirs = (each.coarse.reshape(len(each.coarse), -1) for each in (objects, offered))
    own = own.astype(np.float64)
    filled = np.sqrt(np.outer(own.sum(axis=1), theirs.sum(axis=1))).clip(min=1e-9)
    apart = np.full((len(own), len(offered.coarse)), np.inf)
    best = np.zeros(apart.shape, dtype=np.int64)
    for pose in range(POSES):
        turned = turn_grids(offered.coarse, *turn_of(pose)).reshape(len(offered.coarse), -1)
        squared = (own**2).sum(1)[:, None] + (turned**2).sum(1) - 2 * own @ turned.T
        sizes = turned_extents(offered.log_sizes, pose)
        differ = np.abs(objects.log_sizes[:, None] - sizes).sum(2)
        found = squared / filled + SIZE_WEIGHT * differ
        better = found < apart - 1e-9
        best[better], apart[better] = pose, found[better]
    return apart, best


def turn_of(pose: int) -> tuple[int, bool]:
    """Quarters and whether it is mirrored, as `turn_grids` takes them."""
    return pose % QUARTERS, pose >= QUARTERS


def turned_extents(extents: Float[np.ndarray, "n 3"], pose: int) -> Float[np.ndarray, "n 3"]:
    """Extents along x, y, z of things in a pose."""
    return extents[:, ::-1] if pose % 2 else extents


def turned_looks(
    looks: Int[Tensor, "rooms objects"],
    quarters: Int[Tensor, " rooms"],
    mirrored: Bool[Tensor, " rooms"],
) -> Int[Tensor, "rooms objects"]:
    """The looks of objects in rooms that are perhaps mirrored, then turned by so many quarters."""
    pose = looks % POSES
    own, flipped = pose % QUARTERS, pose >= QUARTERS
    # Mirroring a turn makes it a turn the other way.
    turn = torch.where(mirrored[:, None], -own, own) + quarters[:, None]
    return looks - pose + turn % QUARTERS + QUARTERS * (flipped ^ mirrored[:, None])


def pooled(
    grids: Bool[np.ndarray, "objects x y z"], parts: int
) -> Float[np.ndarray, "objects u v w"]:
    """Means of a grid's cells in so many parts along each axis; cells left over at the end of an
    axis are left out."""
    n, cells = len(grids), grids.shape[1] // parts
    even = grids[:, : parts * cells, : parts * cells, : parts * cells]
    means: np.ndarray = even.reshape(n, parts, cells, parts, cells, parts, cells).mean(
        axis=(2, 4, 6), dtype=np.float32
    )
    return means
