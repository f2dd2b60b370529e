"""Judge layouts by their boxes and classes: lists of `Scene`s in, plain numbers out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from sceneprior.classes import LABEL_SETS, VOID, label_set
from sceneprior.errors import InputError
from sceneprior.scene import Scene

KL_EPSILON = 1e-6
"""Added to both frequencies inside the logarithm, as ATISS does: a class never generated costs
at most p * log(p / 1e-6) instead of infinity."""
OVERLAP_SHARE = 0.01
"""Two boxes intersect when they share more than this part of the smaller one's volume: pieces
that touch, or graze each other by a few millimetres, do not count."""
CENTER_WEIGHT = 0.01
"""Matching cost per metre between centres: decides between boxes that do not overlap, and stays
far below what a change of IoU costs."""
TYPE_CLASSES: dict[str, tuple[str, ...]] = {
    "front3d_bedroom": ("double_bed", "single_bed", "kids_bed"),
    "front3d_living": ("sofa", "armchair"),
}
"""What makes a room one of its type. ScanNet mixes room types and has no entry."""


def class_frequencies(scenes: Sequence[Scene]) -> Float[np.ndarray, "classes"]:
    """Share of each class among all objects of all scenes, void left out (entry 0 is 0).

    Without any object all shares are 0.

    Raises:
        InputError: no scenes, or scenes of different label sets.
    """
    classes = len(label_set(common_label_set(scenes)))
    indices = np.concatenate([scene.class_indices for scene in scenes])
    counts = np.bincount(indices, minlength=classes).astype(np.float64)
    counts[VOID] = 0
    return counts / max(counts.sum(), 1.0)


def common_label_set(*groups: Sequence[Scene]) -> str:
    """The one label set that all these scenes use.

    Raises:
        InputError: there are no scenes, or more than one label set.
    """
    names = sorted({scene.label_set for scenes in groups for scene in scenes})
    if len(names) != 1:
        came = f"label sets {', '.join(names)}" if names else "no scenes"
        raise InputError(
            f"Scores compare scenes of one label set, but {came} came; give scenes whose classes "
            f"are those of the shards ({' or '.join(LABEL_SETS)})."
        )
    return names[0]


def category_kl(generated: Sequence[Scene], test: Sequence[Scene]) -> float:
    """KL divergence of the generated rooms' class frequencies from the test rooms', in nats.

        KL = sum_c p_c * (log(p_c + 1e-6) - log(q_c + 1e-6))

    p are the test rooms' frequencies, q the generated rooms', both without void.

    Raises:
        InputError: either list is empty, or their label sets differ.

    Source:
        Paschalidou et al., "ATISS", NeurIPS 2021, whose epsilon this is. Test rooms, not
        training rooms: the training split flatters.
    """
    common_label_set(generated, test)
    return frequency_kl(class_frequencies(test), class_frequencies(generated))


def frequency_kl(p: Float[np.ndarray, " classes"], q: Float[np.ndarray, " classes"]) -> float:
    """`category_kl` of class frequencies: of q, the generated rooms', from p."""
    return float((p * (np.log(p + KL_EPSILON) - np.log(q + KL_EPSILON))).sum())


def object_counts(scenes: Sequence[Scene]) -> Int[np.ndarray, "scenes"]:
    """Number of objects in each scene, void left out."""
    return np.array([(scene.class_indices != VOID).sum() for scene in scenes], dtype=np.int64)


def holds_its_type(scenes: Sequence[Scene]) -> Bool[np.ndarray, "scenes"] | None:
    """Which scenes hold what their room type stands for (`TYPE_CLASSES`).

    Returns:
        None for a label set without a room type, or for no scenes.
    """
    if not scenes or common_label_set(scenes) not in TYPE_CLASSES:
        return None
    wanted = set(TYPE_CLASSES[common_label_set(scenes)])
    return np.array([any(item.label in wanted for item in scene.objects) for scene in scenes])


def type_share(scenes: Sequence[Scene]) -> float | None:
    """Share of the scenes that hold what their room type stands for; None without a type."""
    holds = holds_its_type(scenes)
    return None if holds is None else float(holds.mean())


@dataclass(frozen=True)
class RoomOverlaps:
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
    shared = _intersections(centers, sizes, centers, sizes)[first, second]
    volumes = sizes.prod(1)
    smaller = np.minimum(volumes[first], volumes[second])
    hits = int((shared > OVERLAP_SHARE * smaller).sum())
    return RoomOverlaps(hits, len(first), float(shared.sum()))


@dataclass(frozen=True)
class Overlaps:
    """How often furniture stands in furniture."""

    per_room: float
    """Mean number of intersecting pairs in a room."""
    share: float
    """Intersecting pairs among all pairs of objects of the same room; 0 where there are none."""


def overlap_pairs(scenes: Sequence[Scene]) -> Overlaps:
    """Count pairs of objects whose boxes intersect, see `room_overlaps`.

    A box is larger than the piece in it (a chair pushed under a table, a piece at an angle), so
    real rooms score above 0 too: read the figure beside theirs.
    """
    rooms = [room_overlaps(scene) for scene in scenes]
    hits, pairs = sum(room.hits for room in rooms), sum(room.pairs for room in rooms)
    return Overlaps(per_room=hits / max(len(scenes), 1), share=hits / max(pairs, 1))


def shared_of_smaller(
    centers_a: Float[np.ndarray, "n 3"],
    sizes_a: Float[np.ndarray, "n 3"],
    centers_b: Float[np.ndarray, "m 3"],
    sizes_b: Float[np.ndarray, "m 3"],
) -> Float[np.ndarray, "n m"]:
    """The part of the smaller box's volume that each box a shares with each box b, in [0, 1].

    0 where a box has no volume.
    """
    shared = _intersections(centers_a, sizes_a, centers_b, sizes_b)
    smaller = np.minimum(sizes_a.prod(1)[:, None], sizes_b.prod(1)[None])
    return np.divide(shared, smaller, out=np.zeros_like(shared), where=smaller > 0)


def _intersections(
    centers_a: np.ndarray, sizes_a: np.ndarray, centers_b: np.ndarray, sizes_b: np.ndarray
) -> np.ndarray:
    low = np.maximum((centers_a - sizes_a / 2)[:, None], (centers_b - sizes_b / 2)[None])
    high = np.minimum((centers_a + sizes_a / 2)[:, None], (centers_b + sizes_b / 2)[None])
    return np.clip(high - low, 0, None).prod(2)


def box_iou_3d(
    centers_a: Float[np.ndarray, "n 3"],
    sizes_a: Float[np.ndarray, "n 3"],
    centers_b: Float[np.ndarray, "m 3"],
    sizes_b: Float[np.ndarray, "m 3"],
) -> Float[np.ndarray, "n m"]:
    """Intersection over union of every axis-aligned box a with every box b, in metres.

    Two boxes without volume have IoU 0.

    Example: two unit cubes that share one half.

        >>> unit = np.ones((1, 3))
        >>> iou = box_iou_3d(np.zeros((1, 3)), unit, np.array([[0.5, 0.0, 0.0]]), unit)
        >>> round(float(iou[0, 0]), 6)
        0.333333
    """
    shared = _intersections(centers_a, sizes_a, centers_b, sizes_b)
    union = sizes_a.prod(1)[:, None] + sizes_b.prod(1)[None] - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)


@dataclass(frozen=True)
class SceneMatch:
    """Which decoded object stands for which true one, decided by boxes alone."""

    decoded: np.ndarray
    """(pairs,) rows of the decoded scene."""
    truth: np.ndarray
    """(pairs,) rows of the true scene."""
    iou: np.ndarray
    """(pairs,) 3D IoU of each pair."""
    correct: np.ndarray
    """(pairs,) bool, the classes agree."""
    truth_count: int
    """Objects of the true scene, matched or not."""

    @property
    def class_accuracy(self) -> float | None:
        """Share of true objects with the right class; an unmatched one is wrong."""
        return float(self.correct.sum()) / self.truth_count if self.truth_count else None

    @property
    def mean_iou(self) -> float | None:
        """Mean IoU over true objects; an unmatched one counts 0."""
        return float(self.iou.sum()) / self.truth_count if self.truth_count else None


def match_scenes(decoded: Scene, truth: Scene) -> SceneMatch:
    """Pair the objects of two scenes one to one, at the least total cost.

        cost = 1 - IoU + 0.01 * (distance of the centres in metres)

    The class takes no part, so that class accuracy is not measured on pairs chosen for it.

    Raises:
        InputError: the scenes use different label sets.
    """
    common_label_set([decoded, truth])
    iou = box_iou_3d(decoded.centers_m, decoded.sizes_m, truth.centers_m, truth.sizes_m)
    apart = np.linalg.norm(decoded.centers_m[:, None] - truth.centers_m[None], axis=2)
    rows, columns = linear_sum_assignment(1 - iou + CENTER_WEIGHT * apart)
    return SceneMatch(
        decoded=rows,
        truth=columns,
        iou=iou[rows, columns],
        correct=decoded.class_indices[rows] == truth.class_indices[columns],
        truth_count=len(truth.objects),
    )


def reconstruction_scores(pairs: Sequence[tuple[Scene, Scene]]) -> dict[str, float | int | None]:
    """Score decoded rooms against their true ones, every true object with the same weight.

    Args:
        pairs: (decoded, truth) of each room.

    Returns:
        class_accuracy and box_iou_3d in [0, 1] (None where no room holds an object),
        count_accuracy: share of rooms with the right number of objects, and rooms, objects.
    """
    matches = [match_scenes(decoded, truth) for decoded, truth in pairs]
    objects = sum(match.truth_count for match in matches)
    same = sum(len(decoded.objects) == len(truth.objects) for decoded, truth in pairs)
    return {
        "class_accuracy": sum(int(m.correct.sum()) for m in matches) / objects if objects else None,
        "box_iou_3d": sum(float(m.iou.sum()) for m in matches) / objects if objects else None,
        "count_accuracy": same / len(pairs) if pairs else None,
        "rooms": len(pairs),
        "objects": objects,
    }
