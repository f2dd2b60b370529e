"""Prototype shapes: a few objects of a data set that, mirrored and turned, represent all others.

A posed prototype, or look, is a prototype shape in one of its `POSES`. It is stored as one number,
prototype * POSES + pose, where pose p mirrors the prototype (x reversed) if p >= 4 and then turns
it about +y by p % 4 quarter turns.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sceneprior.core.boxes import QUARTERS, quarter_rotation, turn_grids
from sceneprior.core.parts import Parts
from sceneprior.core.views import RoomBoxes

POSES = 2 * QUARTERS
"""Poses of a prototype: mirrored or not, times the quarter turns; numbered as in the module's
docstring."""
ALIKE = 0.25
"""Largest distance (`pose_distances`) at which two objects look alike. The distance is the squared
difference of their coarse grids, divided by the geometric mean of the numbers of cells that the two
fill, plus `SIZE_WEIGHT` times the L1 distance of their log extents. Without the division, the legs
of a chair would hardly count."""
SIZE_WEIGHT = 0.3
"""Weight of the difference in log extents; see `ALIKE`."""
COMMON = 3
"""Number of objects, including itself, that a prototype must look like to be common. The most
frequent prototype of each class is always common. The distinction exists because an unusual shape
is more often an error of lifting than truly rare."""
COARSE, PARTS = 8, 4
"""Cells along each axis of the coarse grids that are compared (`COARSE`), and of those that the
sampler's network reads (`PARTS`)."""

BLOCK = 512
"""Objects of a class whose distances to all others are computed at a time, to save memory."""


class Prototypes(NamedTuple):
    """Objects whose shapes represent those of all objects of their classes."""

    parts: tuple[Parts, ...]
    grids: Bool[np.ndarray, "prototypes x y z"]
    """The cells that the parts fill, in the frame of the object's box."""
    sizes_m: Float[np.ndarray, "prototypes 3"]
    object_class: Int[np.ndarray, " prototypes"]
    """Class of each prototype; -1 if it is not used."""
    common: Bool[np.ndarray, " prototypes"]
    """True if the prototype represents several objects (`COMMON`)."""

    def common_alone(self) -> "Prototypes":
        """The same prototypes in the same order, with those that are not common marked as
        unused."""
        return self._replace(object_class=np.where(self.common, self.object_class, -1))

    def shown(self) -> Float[np.ndarray, "looks shown"]:
        """The network's input for each look: its coarse grid and the logarithms of its extents."""
        rows = [
            np.hstack([
                turn_grids(pooled(self.grids, PARTS), *turn_of(pose)).reshape(len(self.grids), -1),
                turned_extents(np.log(self.sizes_m), pose),
            ])
            for pose in range(POSES)
        ]  # fmt: skip
        return np.stack(rows, axis=1).reshape(len(self.grids) * POSES, -1).astype(np.float32)


@dataclass(frozen=True)
class PosedRooms(RoomBoxes):
    """Rooms as boxes with posed prototypes, in the rectangles in which they were furnished."""

    looks: Int[Tensor, "rooms objects"] | None = None
    """Look of each object, prototype * 8 + pose (`lifted/prototypes.py`); None if unknown."""
    rectangle_m: Float[Tensor, "rooms 4"] | None = None
    """Rectangle in which each room was furnished: centre x, z and extents x, z; None if unknown."""
    walls_m: Float[Tensor, "rooms 4"] | None = None
    """Distances of the walls near the furniture from the origin, outwards, at low z, low x, high z
    and high x; NaN where no wall is known. None if no walls are known."""

    def take(self, order: Int[Tensor, "rooms slots"]) -> "PosedRooms":
        """Gather the slots of each room in the order of the indices `order`."""
        # Rectangles and walls have no slots.
        slots = super(PosedRooms, replace(self, rectangle_m=None, walls_m=None)).take(order)
        return replace(slots, rectangle_m=self.rectangle_m, walls_m=self.walls_m)


def choose_prototypes(
    grids: Bool[np.ndarray, "objects x y z"],
    sizes_m: Float[np.ndarray, "objects 3"],
    object_class: Int[np.ndarray, " objects"],
    usable: Bool[np.ndarray, " objects"],
    most: int,
) -> tuple[Int[np.ndarray, " prototypes"], Bool[np.ndarray, " prototypes"]]:
    """Choose the objects that become prototypes, and mark the common ones (`COMMON`).

    For each class, the object that looks like most of the remaining objects is chosen, again and
    again, until every usable object looks like a prototype. The threshold is `ALIKE`, raised by
    half until there are at most `most` prototypes, or one per class.
    """
    apart = []
    for label in np.unique(object_class[usable]):
        rows = np.flatnonzero((object_class == label) & usable)
        own = (grids[rows], sizes_m[rows])
        blocks = np.split(rows, range(BLOCK, len(rows), BLOCK))
        found = [pose_distances(own, (grids[some], sizes_m[some])).min(axis=2) for some in blocks]
        apart.append((rows, np.hstack(found)))
    alike = ALIKE
    while True:
        items, common = list[int](), list[bool]()
        for rows, distance in apart:
            near = (distance <= alike) | np.eye(len(rows), dtype=bool)
            start = len(items)
            while near.any():
                likes = near.sum(axis=0)
                best = int(likes.argmax())
                common.append(len(items) == start or likes[best] >= COMMON)
                items.append(int(rows[best]))
                near[near[:, best]] = False  # these are represented
        if len(items) <= max(most, len(apart)):
            return np.array(items, dtype=np.int64), np.array(common, dtype=bool)
        alike *= 1.5


def embed_posed(
    grids: Bool[np.ndarray, "prototypes x y z"], codes: int
) -> Float[np.ndarray, "looks codes"]:
    """Code vectors of all looks: the leading principal components of their grids.

    The squared distance of two code vectors approximates the number of cells in which the two looks
    differ. `codes` is their length; if there are fewer looks, they are padded with zeros.

    Source:
        Torgerson, "Multidimensional scaling: I. Theory and method", Psychometrika 1952.
    """
    from scipy import linalg  # imported here: training only

    looks = np.stack([turn_grids(grids, *turn_of(pose)) for pose in range(POSES)], axis=1)
    flat = looks.reshape(len(grids) * POSES, -1).astype(np.float32)
    flat -= flat.mean(axis=0)
    # The eigenvalues of the Gram matrix are the squared singular values of the looks, and there are
    # far fewer looks than cells.
    products = (flat @ flat.T).astype(np.float64)
    found = min(codes, len(flat))
    squares, turns = linalg.eigh(products, subset_by_index=(len(flat) - found, len(flat) - 1))
    placed = np.zeros((len(flat), codes), np.float32)
    placed[:, :found] = turns[:, ::-1] * np.sqrt(squares[::-1].clip(min=0))
    return placed


def pose_distances(
    objects: tuple[Bool[np.ndarray, "objects x y z"], Float[np.ndarray, "objects 3"]],
    offered: tuple[Bool[np.ndarray, "offered x y z"], Float[np.ndarray, "offered 3"]],
) -> Float[np.ndarray, "objects offered poses"]:
    """Distance (see `ALIKE`) of each object from each `offered` object in each of its poses.

    Objects are given by their grids and their extents in metres.
    """
    (coarse, log_sizes), (offered_coarse, offered_sizes) = (
        (pooled(grids, COARSE), np.log(sizes_m)) for grids, sizes_m in (objects, offered)
    )
    own = coarse.reshape(len(coarse), -1).astype(np.float64)
    theirs = offered_coarse.reshape(len(offered_coarse), -1)
    filled = np.sqrt(np.outer(own.sum(axis=1), theirs.sum(axis=1))).clip(min=1e-9)
    apart = np.empty((*filled.shape, POSES))
    for pose in range(POSES):
        turned = turn_grids(offered_coarse, *turn_of(pose)).reshape(theirs.shape)
        squared = (own**2).sum(1)[:, None] + (turned**2).sum(1) - 2 * own @ turned.T
        sizes = turned_extents(offered_sizes, pose)
        differ = np.abs(log_sizes[:, None] - sizes).sum(2)
        apart[..., pose] = squared / filled + SIZE_WEIGHT * differ
    return apart


def turn_of(pose: int) -> tuple[int, bool]:
    """Quarter turns and mirroring of a pose, as arguments of `turn_grids`."""
    return pose % QUARTERS, pose >= QUARTERS


def pose_rotation(pose: int) -> Float[np.ndarray, "3 3"]:
    """The matrix of a pose: a mirror image (x reversed) if the pose has one, then quarter turns.

    Its entries are 0 and +-1.
    """
    quarters, mirrored = turn_of(pose)
    rotation: np.ndarray = quarter_rotation(quarters) * ([-1, 1, 1] if mirrored else [1, 1, 1])
    return rotation


def turned_extents(extents: Float[np.ndarray, "n 3"], pose: int) -> Float[np.ndarray, "n 3"]:
    """Extents along x, y, z that objects have in a pose."""
    return extents[:, ::-1] if pose % 2 else extents


def turn_posed(
    looks: Int[Tensor, "rooms objects"],
    quarters: Int[Tensor, " rooms"],
    mirrored: Bool[Tensor, " rooms"],
) -> Int[Tensor, "rooms objects"]:
    """The looks of objects after their rooms are mirrored (optionally), then turned by
    `quarters`."""
    pose = looks % POSES
    own, flipped = pose % QUARTERS, pose >= QUARTERS
    # Mirroring reverses the direction of a turn.
    turn = torch.where(mirrored[:, None], -own, own) + quarters[:, None]
    return looks - pose + turn % QUARTERS + QUARTERS * (flipped ^ mirrored[:, None])


def pooled(
    grids: Bool[np.ndarray, "objects x y z"], parts: int
) -> Float[np.ndarray, "objects u v w"]:
    """Mean occupancy of each of `parts`^3 blocks of a grid; cells left over at the end of an axis
    are dropped."""
    n, cells = len(grids), grids.shape[1] // parts
    even = grids[:, : parts * cells, : parts * cells, : parts * cells]
    means: np.ndarray = even.reshape(n, parts, cells, parts, cells, parts, cells).mean(
        axis=(2, 4, 6), dtype=np.float32
    )
    return means
