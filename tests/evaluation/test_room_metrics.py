"""Metrics of rooms' contents, overlaps, relations and novelty, by hand."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import wasserstein_distance
from toy_metrics import compared_with, of_classes, room, room_set

from sceneprior.core.boxes import box_iou_3d
from sceneprior.core.classes import label_set
from sceneprior.core.scene import Scene
from sceneprior.evaluation.metric import Comparison
from sceneprior.evaluation.metrics import METRICS
from sceneprior.evaluation.metrics.contents import (
    category_kl,
    class_counts,
    reconstruction_scores,
)
from sceneprior.evaluation.metrics.novelty import near_copy_threshold
from sceneprior.evaluation.metrics.overlaps import plausible_pairs, room_overlaps
from sceneprior.evaluation.metrics.relations import (
    FAR_M,
    common_pairs,
    furthest_pairs,
    nearest_gaps,
    relation_distance,
    wasserstein,
)


def kl(generated: list[Scene], test: list[Scene]) -> float:
    once = np.ones((0, len(generated)), int), np.ones((0, len(test)), int)
    return category_kl(class_counts(generated), class_counts(test), *once).value


def test_category_kl_by_hand():
    test = [of_classes("double_bed", "nightstand"), of_classes("double_bed", "desk", "void")]
    generated = [of_classes("double_bed", "nightstand", "nightstand", "desk"), of_classes("void")]
    # test: bed 1/2, nightstand 1/4, desk 1/4; generated: 1/4, 1/2, 1/4
    by_hand = 0.5 * math.log(2) + 0.25 * math.log(1 / 2) + 0.25 * math.log(1)
    # The epsilon of 1e-6 moves each logarithm by at most 4e-6.
    assert kl(generated, test) == pytest.approx(by_hand, abs=4e-6)
    assert kl(test, test) == 0


def test_iou_agrees_with_volumes_counted_on_a_grid():
    # Boxes on whole tenths of a metre: counting 10 cm cells is exact.
    rng = np.random.default_rng(0)
    low = rng.integers(0, 10, size=(12, 3))
    high = low + rng.integers(1, 10, size=(12, 3))
    cells = [
        {*itertools.product(*(range(a, b) for a, b in zip(*corners, strict=True)))}
        for corners in zip(low, high, strict=True)
    ]
    counted = [[len(a & b) / len(a | b) for b in cells] for a in cells]
    centers, sizes = (low + high) / 20, (high - low) / 10
    np.testing.assert_allclose(box_iou_3d(centers, sizes, centers, sizes), counted, atol=1e-12)
    flat = np.array([[1.0, 0, 1]])
    assert box_iou_3d(centers[:1], flat, centers[:1], flat)[0, 0] == 0


def test_reconstruction_scores_weigh_every_true_object_alike():
    one = (of_classes("desk"), of_classes("desk"))
    three = (of_classes("desk", "sofa"), of_classes("desk", "desk", "table"))
    scores = reconstruction_scores([one, three])
    assert scores["class_accuracy"] == pytest.approx(2 / 4)
    assert scores["box_iou_3d"] == pytest.approx(3 / 4)
    assert scores["count_accuracy"] == 0.5
    assert (scores["rooms"], scores["objects"]) == (2, 4)
    assert reconstruction_scores([])["box_iou_3d"] is None


CLASSES = label_set("front3d_bedroom")
UNDER = room(("desk", (0, 0.5, 0)), ("chair", (0.5, 0.5, 0)))
BESIDE = room(("desk", (0, 0.5, 0)), ("chair", (2, 0.5, 0)))


def test_overlaps_by_hand():
    # Cubes at 0, 0.5 and 5; a fourth shares 0.5% with the third; a void one inside the first.
    scene = room(
        ("desk", (0, 0.5, 0)), ("chair", (0.5, 0.5, 0)), ("sofa", (5, 0.5, 0)),
        ("stool", (5.995, 0.5, 0)), ("void", (0, 0.5, 0)),
    )  # fmt: skip
    pair = sorted((CLASSES.index("desk"), CLASSES.index("chair")))
    overlaps = room_overlaps(scene)
    assert overlaps.classes[overlaps.intersect].tolist() == [pair]
    assert overlaps.volumes_m3[overlaps.intersect].tolist() == [0.5]
    assert overlaps.depths_m[overlaps.intersect].tolist() == [0.5]
    # The stool shares half a percent of the sofa, so only its depth tells: 5 mm.
    grazing = ~overlaps.intersect & (overlaps.volumes_m3 > 0)
    np.testing.assert_allclose(overlaps.depths_m[grazing], [0.005], atol=1e-12)


def pairs_of(found) -> set[tuple[str, str]]:
    return {(CLASSES[a], CLASSES[b]) for a, b in np.argwhere(found)}


def test_pairs_are_plausible_that_intersect_in_one_of_twenty_rooms_with_both():
    alone = of_classes("desk", "sofa")  # holds no chair, so it says nothing of desk and chair
    both = {("desk", "chair"), ("chair", "desk")}
    assert pairs_of(plausible_pairs([UNDER, *[BESIDE] * 19, *[alone] * 50])) == both
    assert pairs_of(plausible_pairs([UNDER, *[BESIDE] * 20])) == set()
    # Of one class, rooms that hold two of it count; one room counts once, however many pairs.
    two = room(("chair", (0, 0.5, 0)), ("chair", (0.5, 0.5, 0)), ("chair", (0.4, 0.5, 0)))
    apart = of_classes("chair", "chair")
    assert pairs_of(plausible_pairs([two, *[apart] * 19, *[of_classes("chair")] * 90])) == {
        ("chair", "chair")
    }
    assert pairs_of(plausible_pairs([two, *[apart] * 20])) == set()


CLASSES = label_set("front3d_bedroom")
BED, STAND, CHAIR = (CLASSES.index(name) for name in ("double_bed", "nightstand", "chair"))


def bedroom(gap: float, **changes):
    """A bed of 1 m, and a nightstand beside it."""
    return replace(room(("double_bed", (0, 0.5, 0)), ("nightstand", (1 + gap, 0.5, 0))), **changes)


def test_gaps_by_hand():
    # Unit cubes: two beds 3.5 m apart; the nightstand 0.5 m from one, off the corner of the other.
    scene = room(
        ("double_bed", (0, 0.5, 0)), ("double_bed", (4.5, 0.5, 4)), ("nightstand", (1.5, 0.5, 0)),
        ("chair", (1.5, 2.5, 0.2)), ("void", (1.5, 0.5, 0)),
    )  # fmt: skip
    got = {pair: gaps.gaps_m.tolist() for pair, gaps in nearest_gaps([scene]).items()}
    assert got[STAND, BED] == [0.5] and got[BED, STAND] == [0.5, FAR_M]
    assert got[BED, BED] == [FAR_M, FAR_M]
    assert got[CHAIR, STAND] == [0.0], "above it: the footprints meet"
    assert (STAND, STAND) not in got and not any(0 in pair for pair in got)
    corner = room(("double_bed", (0, 0.5, 0)), ("nightstand", (1.3, 0.5, 1.4)))
    assert nearest_gaps([corner])[STAND, BED].gaps_m[0] == pytest.approx(0.5)


def test_the_distance_is_scipys_for_all_weightings_at_once(rng):
    a, b = rng.uniform(0, 3, 12), rng.uniform(1, 3, 7)
    weights_a, weights_b = rng.integers(0, 3, (5, 12)), rng.integers(1, 3, (5, 7))
    got = wasserstein(a, b, weights_a, weights_b)
    for row, weights in enumerate(zip(weights_a, weights_b, strict=True)):
        assert got[row] == pytest.approx(wasserstein_distance(a, b, *weights), abs=1e-12)
    assert np.isnan(wasserstein(a, b, np.zeros((1, 12), int), np.ones((1, 7), int)))


def test_pairs_count_that_one_real_room_in_twenty_has():
    rooms = [bedroom(0.1)] + [of_classes("chair")] * 19
    assert common_pairs(rooms) == [(BED, STAND), (STAND, BED)]
    assert common_pairs([*rooms, of_classes("chair")]) == []


def against(test, real):
    comparison = compared_with(room_set(test, []), real=real)
    train = {"relation_distance_m": relation_distance(room_set(real, []), comparison)}
    comparison.columns["train_rooms"] = train
    return comparison


def test_common_pairs_weigh_more_and_the_table_begins_with_what_is_off_most():
    """Ten nightstands 1 m off and one chair 2 m off its desk: 20 gaps and 2."""
    desk = [("desk", (0, 0.5, 0)), ("chair", (1, 0.5, 0))]
    real = [bedroom(0.0)] * 10 + [room(*desk)]
    comparison = against(real, real)
    off = room_set([bedroom(1.0)] * 10 + [room(desk[0], ("chair", (3, 0.5, 0)))], [])
    distance = relation_distance(off, comparison).value
    assert distance == pytest.approx((20 * 1.0 + 2 * 2.0) / 22)
    pairs = [(row["of"], row["to"]) for row in furthest_pairs(off, room_set(real, []), comparison)]
    assert pairs[0] in (("nightstand", "double_bed"), ("double_bed", "nightstand"))
    assert len(pairs) == 4


FUNCTIONS = {metric.key: metric.function for metric in METRICS if metric.key.startswith("near")}
LABELS = ("desk", "chair", "sofa")


@pytest.fixture
def training(rng) -> list[Scene]:
    """Thirty rooms of three pieces; two kinds of furnishing, so that many hold the same."""
    rooms = [
        room(*((label, rng.uniform(-2, 2, 3)) for label in (*LABELS[: 2 + row % 2], "bookshelf")))
        for row in range(30)
    ]
    return [replace(scene, name=f"room_{row}") for row, scene in enumerate(rooms)]


def compared(training, test) -> Comparison:
    return compared_with(room_set(test, training), near_copy_m=near_copy_threshold(training))


def values(rooms, comparison) -> dict[str, float]:
    found = {key: function(rooms, comparison) for key, function in FUNCTIONS.items()}
    return {key: estimate.value for key, estimate in found.items() if estimate is not None}


def nudged(scenes, metres) -> list[Scene]:
    def moved(item):
        return replace(item, center_m=(item.center_m[0] + metres, *item.center_m[1:]))

    return [replace(s, name="new", objects=tuple(map(moved, s.objects))) for s in scenes]


def test_a_copy_of_what_the_prior_remembers_is_one_though_the_true_room_is_far(training):
    decoded = [replace(s, name=t.name) for s, t in zip(nudged(training, 5), training, strict=True)]
    comparison = compared(training, training[:2])
    drawn = room_set(nudged(decoded, 0.01), training, decoded)
    assert values(drawn, comparison)["near_copy_share"] == 1
    assert values(drawn, comparison)["nearest_decoded_m"] == pytest.approx(0.01)
    # One object added or left out does not make another room; two do.
    copies = nudged(decoded, 0.01)
    for objects, share in (
        (lambda s: (*s.objects, s.objects[0]), 1),
        (lambda s: s.objects[1:], 1),
        (lambda s: (*s.objects, *s.objects[:2]), 0),
    ):
        changed = [replace(s, objects=objects(s)) for s in copies]
        found = values(room_set(changed, training, decoded), comparison)
        assert found["near_copy_share"] == share


def test_the_threshold_is_what_one_real_room_in_a_hundred_falls_below(training):
    threshold = near_copy_threshold(training)
    copies = room_set(training, training, own=True).nearest.as_copies_m
    assert threshold == np.quantile(copies, 0.01, method="higher")
    assert near_copy_threshold(training[:1]) == 0  # nothing is nearer than that
    # Where no two rooms hold the same furniture, nothing can be a copy of another.
    assert near_copy_threshold([training[0], of_classes("sofa", "stool", "wardrobe")]) == 0
