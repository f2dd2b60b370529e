"""Intersections of the boxes of a room's objects."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sceneprior.core.classes import VOID
from sceneprior.core.scene import Scene
from sceneprior.evaluation.metric import (
    Comparison,
    Estimate,
    RoomSet,
    TableColumn,
    mean_of_rooms,
    mean_over_rooms,
    metric,
)
from sceneprior.evaluation.metrics.contents import class_counts

OVERLAP_SHARE = 0.01
"""Share of the smaller box's volume above which two boxes intersect; objects that touch, or overlap
by a few millimetres, stay below it."""
DEEP_M = 0.01
"""Penetration depth, in metres, above which two boxes count as a deep pair."""
PLAUSIBLE_SHARE = 0.05
"""A pair of classes is plausible if it intersects in at least this share of the real training rooms
that hold both."""


class RoomOverlaps(NamedTuple):
    """All pairs of objects of one room, and the intersections of their boxes."""

    classes: Int[np.ndarray, "pairs 2"]
    """Class indices of each pair, the smaller first."""
    volumes_m3: Float[np.ndarray, " pairs"]
    """Volume shared by the two boxes."""
    shares: Float[np.ndarray, " pairs"]
    """Shared volume as a part of the smaller box's volume."""
    depths_m: Float[np.ndarray, " pairs"]
    """Penetration depth: the smallest shift along one axis that separates the boxes."""

    @property
    def intersect(self) -> Bool[np.ndarray, " pairs"]:
        """True for pairs that share more than `OVERLAP_SHARE` of the smaller box."""
        return np.asarray(self.shares > OVERLAP_SHARE)


def room_overlaps(scene: Scene) -> RoomOverlaps:
    """Compare every pair of objects of a room by their axis-aligned boxes, void objects left out.

    A box is larger than its object (a chair pushed under a table, a rotated object), so boxes also
    intersect in real rooms: compare results with the number in real rooms.
    """
    known = scene.class_indices != VOID
    classes = scene.class_indices[known]
    low = (scene.centers_m - scene.sizes_m / 2)[known]
    high = (scene.centers_m + scene.sizes_m / 2)[known]
    a, b = np.triu_indices(len(classes), k=1)
    shared = np.clip(np.minimum(high[a], high[b]) - np.maximum(low[a], low[b]), 0, None)
    apart = np.minimum(high[a] - low[b], high[b] - low[a])
    volumes, each = shared.prod(1), scene.sizes_m[known].prod(1)
    smaller = np.minimum(each[a], each[b])
    return RoomOverlaps(
        np.sort(np.stack([classes[a], classes[b]], axis=1), axis=1),
        volumes,
        np.divide(volumes, smaller, out=np.zeros_like(volumes), where=smaller > 0),
        np.where(volumes > 0, apart.min(axis=1, initial=np.inf), 0.0),
    )


def plausible_pairs(training: Sequence[Scene]) -> Bool[np.ndarray, "classes classes"]:
    """Pairs of classes that intersect in real rooms, such as a chair and its table.

    An entry is True if objects of the two classes intersect in at least 5% of the real training
    rooms that hold both classes (on the diagonal: that hold two objects of the class). The matrix
    is symmetric.

    Raises InputError like `class_counts`.
    """
    counts = class_counts(training)
    holds, several = (counts > 0).astype(int), (counts > 1).astype(int)
    together = holds.T @ holds
    np.fill_diagonal(together, several.sum(0))
    intersecting = np.zeros_like(together)
    for scene in training:
        overlaps = room_overlaps(scene)
        for first, second in {(int(a), int(b)) for a, b in overlaps.classes[overlaps.intersect]}:
            intersecting[first, second] += 1
    intersecting = np.maximum(intersecting, intersecting.T)
    return np.asarray((intersecting > 0) & (intersecting >= PLAUSIBLE_SHARE * together))


def _mean_of_pairs(
    of_pairs: Callable[[RoomOverlaps], np.ndarray], plausible: bool
) -> Callable[[RoomSet, Comparison], Estimate]:
    """Build a metric's function: the mean over rooms of a sum over (im)plausible pairs."""

    def function(rooms: RoomSet, comparison: Comparison) -> Estimate:
        def total(scene: Scene) -> float:
            overlaps = room_overlaps(scene)
            chosen = comparison.plausible_pairs[tuple(overlaps.classes.T)] == plausible
            return float(of_pairs(overlaps)[chosen].sum())

        return mean_of_rooms([total(scene) for scene in rooms.scenes], rooms.counts)

    return function


metric(
    "implausible_pairs", "Implausible intersecting pairs in a room", "mean", "lower",
    protocol={
        "implausible_pairs": f"boxes sharing more than {OVERLAP_SHARE:.0%} of the smaller one, "
        f"classes that do so in under {PLAUSIBLE_SHARE:.0%} of the real training rooms that hold "
        "both"
    },
    column=TableColumn(
        "implausible pairs", 2,
        "implausible pairs: intersecting pairs per room, of classes that seldom intersect in "
        "real training rooms",
    ),
)(_mean_of_pairs(lambda overlaps: overlaps.intersect, plausible=False))  # fmt: skip
metric(
    "deep_pairs", "Implausible pairs deeper than 1 cm", "mean", "lower",
    protocol={"deep_pairs": f"penetration over {DEEP_M} m, classes as in implausible_pairs"},
    column=TableColumn("deeper than 1 cm", 2, "deeper than 1 cm: such pairs by depth"),
)(_mean_of_pairs(lambda overlaps: overlaps.depths_m > DEEP_M, plausible=False))  # fmt: skip
metric("implausible_litres", "Volume shared by implausible pairs", "mean, litres", "lower")(
    _mean_of_pairs(lambda overlaps: 1000 * overlaps.volumes_m3, plausible=False)
)
metric(
    "plausible_pairs", "Plausible intersecting pairs in a room", "mean", "none",
    column=TableColumn(
        "plausible pairs", 2,
        "plausible pairs: all other intersecting pairs, such as chairs under tables; near the "
        "real rooms' number is good",
    ),
)(_mean_of_pairs(lambda overlaps: overlaps.intersect, plausible=True))  # fmt: skip
metric("overlap_volume_m3", "Volume shared by all pairs in a room", "mean, cubic metres", "none")(
    mean_over_rooms(lambda scene: float(room_overlaps(scene).volumes_m3.sum()))
)
