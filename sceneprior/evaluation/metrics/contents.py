"""Contents of rooms: class frequencies, numbers of objects, furniture of a room type, and pairs of
objects whose boxes intersect; and decoded training rooms beside the ground truth."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Int

from sceneprior.core.boxes import SceneMatch, match_scenes
from sceneprior.core.classes import LABEL_SETS, VOID, label_set
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene
from sceneprior.evaluation.geometry import BoxPairs, box_pairs
from sceneprior.evaluation.metric import (
    AGAINST_TEST,
    DEFINED,
    MATCHED,
    Comparison,
    Estimate,
    RoomSet,
    TableColumn,
    mean_of_rooms,
    mean_over_rooms,
    metric,
)

KL_EPSILON = 1e-6
"""Added to both frequencies inside the logarithm, as in ATISS: a class that is never generated
costs about p * log(p / 1e-6) instead of infinity."""
TYPE_CLASSES: dict[str, tuple[str, ...]] = {
    "front3d_bedroom": ("double_bed", "single_bed", "kids_bed"),
    "front3d_living": ("sofa", "armchair"),
}
"""Classes that define a room type: a room of the type holds an object of at least one of them.
ScanNet has no entry, since its scans mix room types."""
OVERLAP_SHARE = 0.01
"""Share of the smaller box's volume above which two boxes intersect; objects that touch, or overlap
by a few millimetres, stay below it."""
DEEP_M = 0.01
"""Penetration depth, in metres, above which two boxes count as a deep pair."""
PLAUSIBLE_SHARE = 0.05
"""A pair of classes is plausible if it intersects in at least this share of the real training rooms
that hold both."""


def common_label_set(*groups: Sequence[Scene]) -> str:
    """The label set that all scenes share; raises InputError if they share none."""
    names = sorted({scene.label_set for scenes in groups for scene in scenes})
    if len(names) != 1:
        came = f"label sets {', '.join(names)}" if names else "no scenes"
        raise InputError(
            f"Scores compare scenes of one label set, but {came} were given; give scenes whose "
            f"classes are those of the shards ({' or '.join(LABEL_SETS)})."
        )
    return names[0]


def without_void(scene: Scene) -> Scene:
    """The scene without objects of class void; metrics expect such scenes."""
    known = zip(scene.objects, scene.class_indices, strict=True)
    return replace(scene, objects=tuple(item for item, index in known if index != VOID))


def class_counts(scenes: Sequence[Scene]) -> Int[np.ndarray, "scenes classes"]:
    """Number of objects of each class in each scene.

    Raises InputError like `common_label_set`.
    """
    classes = len(label_set(common_label_set(scenes)))
    return np.stack([np.bincount(scene.class_indices, minlength=classes) for scene in scenes])


def category_kl(
    rooms: Int[np.ndarray, "rooms classes"],
    test: Int[np.ndarray, "test classes"],
    counts: Int[np.ndarray, "sets rooms"],
    test_counts: Int[np.ndarray, "sets test"],
) -> Estimate:
    """KL divergence of the generated rooms' class frequencies q from the test rooms' p, in nats,
    from the objects of each class.

        KL = sum_c p_c * (log(p_c + 1e-6) - log(q_c + 1e-6))  (Paschalidou et al., NeurIPS 2021)

    Comparing with training rooms instead of test rooms would give values that are too good.
    """

    q, p = (
        table / np.maximum(table.sum(axis=1, keepdims=True), 1)
        for table in (counts @ rooms, test_counts @ test)
    )
    terms = p * (np.log(p + KL_EPSILON) - np.log(q + KL_EPSILON))
    return Estimate(terms.sum(axis=1), 0.0)


@metric(
    "category_kl", "Category KL to test rooms", "nats", "closer", AGAINST_TEST,
    protocol=f"KL(test || generated) in nats, epsilon {KL_EPSILON}, without void",
    column=TableColumn("category KL", 3),
)  # fmt: skip
def _category_kl(rooms: RoomSet, comparison: Comparison) -> Estimate:
    test = comparison.test
    tables = class_counts(rooms.scenes), class_counts(test.scenes)
    return category_kl(*tables, rooms.counts, test.counts)


metric("mean_objects", "Objects in a room", "mean", "none", column=TableColumn("objects", 2))(
    mean_over_rooms(lambda scene: len(scene.objects))
)


@metric(
    "type_share", "Rooms that hold their type's furniture", "share", "higher",
    column=TableColumn("type", 2, "type: rooms that hold the furniture their type needs"),
)  # fmt: skip
@partial(mean_over_rooms, high=1.0)
def _holds_its_type(scene: Scene) -> bool | None:
    """True if a scene holds the furniture of its room type; None without a room type."""
    wanted = TYPE_CLASSES.get(scene.label_set)
    return None if wanted is None else any(item.label in wanted for item in scene.objects)


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
    rooms = np.zeros_like(together)
    for scene in training:
        found = np.zeros(together.shape, dtype=bool)
        pairs = box_pairs(scene.centers_m, scene.sizes_m)
        first, second = (scene.class_indices[rows[intersecting(pairs)]] for rows in pairs.rows)
        found[first, second] = found[second, first] = True
        rooms += found
    return np.asarray((rooms > 0) & (rooms >= PLAUSIBLE_SHARE * together))


def intersecting(pairs: BoxPairs) -> np.ndarray:
    """True for pairs that share more than `OVERLAP_SHARE` of the smaller box."""
    return pairs.shares > OVERLAP_SHARE


def sum_over_pairs(
    scene: Scene,
    chosen: Bool[np.ndarray, "classes classes"],
    of_pairs: Callable[[BoxPairs], np.ndarray],
) -> float:
    """The sum of a number of each pair of objects over pairs of chosen classes."""
    pairs = box_pairs(scene.centers_m, scene.sizes_m)
    first, second = (scene.class_indices[rows] for rows in pairs.rows)
    return float(of_pairs(pairs)[chosen[first, second]].sum())


def _mean_of_pairs(
    of_pairs: Callable[[BoxPairs], np.ndarray], plausible: bool
) -> Callable[[RoomSet, Comparison], Estimate]:
    """Build a metric's function: the mean over rooms of a sum over (im)plausible pairs."""

    def function(rooms: RoomSet, comparison: Comparison) -> Estimate:
        chosen = comparison.plausible_pairs == plausible
        sums = [sum_over_pairs(scene, chosen, of_pairs) for scene in rooms.scenes]
        return mean_of_rooms(sums, rooms.counts)

    return function


def shared_volume_m3(scene: Scene) -> float:
    """Volume shared by the boxes of all pairs of objects, in cubic metres."""
    return float(box_pairs(scene.centers_m, scene.sizes_m).volumes_m3.sum())


metric(
    "implausible_pairs", "Implausible intersecting pairs in a room", "mean", "lower",
    protocol=f"boxes sharing more than {OVERLAP_SHARE:.0%} of the smaller one, "
    f"classes that do so in under {PLAUSIBLE_SHARE:.0%} of the real training rooms that hold "
    "both",
    column=TableColumn(
        "implausible pairs", 2,
        "implausible pairs: intersecting pairs per room, of classes that seldom intersect in "
        "real training rooms",
    ),
)(_mean_of_pairs(intersecting, plausible=False))  # fmt: skip
metric(
    "deep_pairs", "Implausible pairs deeper than 1 cm", "mean", "lower",
    protocol=f"penetration over {DEEP_M} m, classes as in implausible_pairs",
    column=TableColumn("deeper than 1 cm", 2, "deeper than 1 cm: such pairs by depth"),
)(_mean_of_pairs(lambda pairs: pairs.depths_m > DEEP_M, plausible=False))  # fmt: skip
metric("implausible_litres", "Volume shared by implausible pairs", "mean, litres", "lower")(
    _mean_of_pairs(lambda pairs: 1000 * pairs.volumes_m3, plausible=False)
)
metric(
    "plausible_pairs", "Plausible intersecting pairs in a room", "mean", "none",
    column=TableColumn(
        "plausible pairs", 2,
        "plausible pairs: all other intersecting pairs, such as chairs under tables; near the "
        "real rooms' number is good",
    ),
)(_mean_of_pairs(intersecting, plausible=True))  # fmt: skip
metric("overlap_volume_m3", "Volume shared by all pairs in a room", "mean, cubic metres", "none")(
    mean_over_rooms(shared_volume_m3)
)


def reconstruction_scores(pairs: Sequence[tuple[Scene, Scene]]) -> dict[str, float | int | None]:
    """Scores of (decoded, true) rooms: the metrics of `MATCHED` rooms by key, and the numbers of
    rooms and objects.

    Every true object has the same weight. Scores of objects are None if no room holds any.
    """
    matches = [match_scenes(decoded, truth) for decoded, truth in pairs]
    scores = {each.key: each.function(matches) for each in DEFINED if each.sets == MATCHED}
    objects = sum(match.truth_count for match in matches)
    return {**scores, "rooms": len(pairs), "objects": objects}


def _mean_over_objects(name: str, matches: Sequence[SceneMatch]) -> float | None:
    """The mean over true objects of an attribute of matches, 0 for objects without a match."""
    objects = sum(match.truth_count for match in matches)
    total = sum(float(getattr(match, name).sum()) for match in matches)
    return total / objects if objects else None


metric(
    "class_accuracy", "Classes of decoded training rooms", "share of objects", "higher", MATCHED
)(partial(_mean_over_objects, "correct"))
metric(
    "box_iou_3d", "Box IoU of decoded training rooms", "IoU", "higher", MATCHED,
    column=TableColumn(
        "train box IoU", 2, "train box IoU: decoded training rooms against the truth"
    ),
)(partial(_mean_over_objects, "iou"))  # fmt: skip


@metric(
    "count_accuracy", "Numbers of objects of decoded training rooms", "share of rooms", "higher",
    MATCHED,
)  # fmt: skip
def _count_accuracy(matches: Sequence[SceneMatch]) -> float | None:
    same = sum(match.decoded_count == match.truth_count for match in matches)
    return same / len(matches) if matches else None
