"""How much furniture stands in furniture: intersections of the boxes of a room's objects."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sceneprior.classes import VOID
from sceneprior.evaluation.bootstrap import Estimate, ratio
from sceneprior.evaluation.metric import Comparison, Metric, RoomSet, TableColumn, mean_over_rooms
from sceneprior.scene import Scene

OVERLAP_SHARE = 0.01
"""Two boxes intersect when they share more than this part of the smaller one's volume: pieces
that touch, or graze each other by a few millimetres, do not count."""


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

    hits: int
    """Intersecting pairs."""
    pairs: int
    """All pairs of objects."""
    volume_m3: float
    """What all pairs share, intersecting or grazing, summed."""


def room_overlaps(scene: Scene) -> RoomOverlaps:
    """Compare every pair of objects of a room by their axis-aligned boxes.

    A pair intersects when its boxes share more than 1% of the smaller box's volume. Lamps take
    part, void does not.
    """
    known = scene.class_indices != VOID
    centers, sizes = scene.centers_m[known], scene.sizes_m[known]
    first, second = np.triu_indices(len(centers), k=1)
    shared = intersection_volumes(centers, sizes, centers, sizes)[first, second]
    volumes = sizes.prod(1)
    smaller = np.minimum(volumes[first], volumes[second])
    hits = int((shared > OVERLAP_SHARE * smaller).sum())
    return RoomOverlaps(hits, len(first), float(shared.sum()))


def overlap_pairs(scenes: Sequence[Scene]) -> float:
    """Mean number of intersecting pairs in a room, see `room_overlaps`.

    A box is larger than the piece in it (a chair pushed under a table, a piece at an angle), so
    real rooms score above 0 too: read the number beside theirs.
    """
    return sum(room_overlaps(scene).hits for scene in scenes) / max(len(scenes), 1)


def _pair_share(rooms: RoomSet, comparison: Comparison) -> Estimate:
    hits, pairs, _ = np.array([room_overlaps(scene) for scene in rooms.scenes]).T
    # A set of rooms with one object each holds no pair that could intersect: 0, not nothing.
    return ratio(hits, pairs if pairs.any() else np.ones(len(hits)), rooms.counts, 1.0)


METRICS = (
    Metric(
        "overlap_pairs", "Intersecting pairs in a room", "mean", "lower",
        "Mean number of intersecting pairs in a room: boxes that share more than 1% of the "
        "smaller one's volume; lamps take part.",
        mean_over_rooms(lambda scene: room_overlaps(scene).hits),
        protocol={"overlap_pairs": f"boxes sharing more than {OVERLAP_SHARE:.0%} of the smaller "
                  "one"},
        column=TableColumn("overlaps", 2, "overlaps: intersecting pairs a room"),
    ),
    Metric(
        "overlap_pair_share", "Intersecting pairs among all pairs", "share", "lower",
        "Intersecting pairs among all pairs of objects of the same room; 0 where no room has a "
        "pair.",
        _pair_share,
    ),
    Metric(
        "overlap_volume_m3", "Volume shared by pairs in a room", "mean, cubic metres", "lower",
        "Mean over rooms of the volumes that all pairs share, summed; grazing pairs take part.",
        mean_over_rooms(lambda scene: room_overlaps(scene).volume_m3),
    ),
)  # fmt: skip
