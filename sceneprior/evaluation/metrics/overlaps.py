"""How much furniture stands in furniture: intersections of the boxes of a room's objects."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sceneprior.classes import VOID
from sceneprior.evaluation.bootstrap import Estimate, mean_of_rooms
from sceneprior.evaluation.metric import Comparison, Metric, RoomSet, TableColumn, mean_over_rooms
from sceneprior.evaluation.metrics.contents import class_counts
from sceneprior.scene import Scene

OVERLAP_SHARE = 0.01
"""Two boxes intersect when they share more than this part of the smaller one's volume: pieces
that touch, or graze each other by a few millimetres, do not count."""
PLAUSIBLE_SHARE = 0.05
"""Two classes may intersect that do so in at least this part of the real training rooms that hold
both."""


def intersection_volumes(
    centers_a: Float[np.ndarray, "n 3"],
    sizes_a: Float[np.ndarray, "n 3"],
    centers_b: Float[np.ndarray, "m 3"],
    sizes_b: Float[np.ndarray, "m 3"],
) -> Float[np.ndarray, "n m"]:
    """What every axis-aligned box a shares with every box b, in cubic metres."""
    low = np.maximum((centers_a - sizes_a / 2)[:, None], (centers_b - sizes_b / 2)[None])
    high = np.minimum((centers_a + sizes_a / 2)[:, None], (centers_b + sizes_b / 2)[None])
    return np.asarray(np.clip(high - low, 0, None).prod(2))


def shared_of_smaller(a: Scene, b: Scene) -> Float[np.ndarray, "n m"]:
    """The part of the smaller box's volume that each box of a shares with each of b, in [0, 1].

    0 where a box has no volume.
    """
    shared = intersection_volumes(a.centers_m, a.sizes_m, b.centers_m, b.sizes_m)
    smaller = np.minimum(a.sizes_m.prod(1)[:, None], b.sizes_m.prod(1)[None])
    return np.divide(shared, smaller, out=np.zeros_like(shared), where=smaller > 0)


class RoomOverlaps(NamedTuple):
    """The furniture that stands in furniture of one room."""

    hits: Int[np.ndarray, "hits 2"]
    """Class indices of the intersecting pairs, the smaller first."""
    volume_m3: float
    """What all pairs share, intersecting or grazing, summed."""


def room_overlaps(scene: Scene) -> RoomOverlaps:
    """Compare every pair of objects of a room by their axis-aligned boxes.

    A pair intersects when its boxes share more than 1% of the smaller box's volume. Lamps take
    part, void does not.
    """
    known = scene.class_indices != VOID
    classes = scene.class_indices[known]
    centers, sizes = scene.centers_m[known], scene.sizes_m[known]
    first, second = np.triu_indices(len(centers), k=1)
    shared = intersection_volumes(centers, sizes, centers, sizes)[first, second]
    volumes = sizes.prod(1)
    smaller = np.minimum(volumes[first], volumes[second])
    hit = shared > OVERLAP_SHARE * smaller
    pairs = np.sort(np.stack([classes[first[hit]], classes[second[hit]]], axis=1), axis=1)
    return RoomOverlaps(pairs, float(shared.sum()))


def overlap_pairs(scenes: Sequence[Scene]) -> float:
    """Mean number of intersecting pairs in a room, plausible ones among them: see `room_overlaps`.

    A box is larger than the piece in it (a chair pushed under a table, a piece at an angle), so
    real rooms score above 0 too: read the number beside theirs.
    """
    return sum(len(room_overlaps(scene).hits) for scene in scenes) / max(len(scenes), 1)


def plausible_pairs(training: Sequence[Scene]) -> Bool[np.ndarray, "classes classes"]:
    """Pairs of classes that real rooms let intersect, such as a chair and its table.

    True where objects of the two classes intersect in at least 5% of the real training rooms that
    hold both (of one class: that hold two of it); symmetric.

    Raises InputError like `class_counts`.
    """
    counts = class_counts(training)
    holds, several = (counts > 0).astype(int), (counts > 1).astype(int)
    together = holds.T @ holds
    np.fill_diagonal(together, several.sum(0))
    intersecting = np.zeros_like(together)
    for scene in training:
        for first, second in {(int(a), int(b)) for a, b in room_overlaps(scene).hits}:
            intersecting[first, second] += 1
    intersecting = np.maximum(intersecting, intersecting.T)
    return np.asarray((intersecting > 0) & (intersecting >= PLAUSIBLE_SHARE * together))


def _pairs(plausible: bool, rooms: RoomSet, comparison: Comparison) -> Estimate:
    def count(scene: Scene) -> int:
        first, second = room_overlaps(scene).hits.T
        return int((comparison.plausible_pairs[first, second] == plausible).sum())

    return mean_of_rooms([count(scene) for scene in rooms.scenes], rooms.counts)


METRICS = (
    Metric(
        "implausible_pairs", "Implausible intersecting pairs in a room", "mean", "lower",
        "Mean number of intersecting pairs in a room (boxes that share more than 1% of the smaller "
        "one's volume; lamps take part) of two classes that intersect in fewer than 5% of the real "
        "training rooms that hold both.",
        partial(_pairs, False),
        protocol={"implausible_pairs": f"boxes sharing more than {OVERLAP_SHARE:.0%} of the "
                  f"smaller one, classes that do so in under {PLAUSIBLE_SHARE:.0%} of the real "
                  "training rooms that hold both"},
        column=TableColumn(
            "implausible pairs", 2,
            "implausible pairs: intersecting pairs a room of classes that seldom intersect in real "
            "training rooms",
        ),
    ),
    Metric(
        "plausible_pairs", "Plausible intersecting pairs in a room", "mean", "none",
        "All other intersecting pairs, such as a chair pushed under a table.",
        partial(_pairs, True),
    ),
    Metric(
        "overlap_volume_m3", "Volume shared by pairs in a room", "mean, cubic metres", "lower",
        "Mean over rooms of the volumes that all pairs share, summed; grazing pairs take part.",
        mean_over_rooms(lambda scene: room_overlaps(scene).volume_m3),
    ),
)  # fmt: skip
