"""Metrics of rooms' contents, layouts and novelty, by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import wasserstein_distance
from toy_metrics import compared_with, of_classes, room, room_set

from sceneprior.core.classes import label_set
from sceneprior.core.scene import Scene
from sceneprior.evaluation.geometry import box_pairs
from sceneprior.evaluation.metrics import METRICS
from sceneprior.evaluation.metrics.contents import (
    category_kl,
    class_counts,
    intersecting,
    plausible_pairs,
    reconstruction_scores,
)
from sceneprior.evaluation.metrics.layouts import (
    wasserstein,
)
from sceneprior.evaluation.metrics.novelty import near_copy_threshold

CLASSES = label_set("front3d_bedroom")
BED, STAND, CHAIR = (CLASSES.index(name) for name in ("double_bed", "nightstand", "chair"))
UNDER = room(("desk", (0, 0.5, 0)), ("chair", (0.5, 0.5, 0)))
BESIDE = room(("desk", (0, 0.5, 0)), ("chair", (2, 0.5, 0)))


def kl(generated: list[Scene], test: list[Scene]) -> float:
    once = np.ones((1, len(generated)), int), np.ones((1, len(test)), int)
    return category_kl(class_counts(generated), class_counts(test), *once).value


def test_category_kl_by_hand():
    test = [of_classes("double_bed", "nightstand"), of_classes("double_bed", "desk")]
    generated = [of_classes("double_bed", "nightstand", "nightstand", "desk"), of_classes()]
    # test: bed 1/2, nightstand 1/4, desk 1/4; generated: 1/4, 1/2, 1/4
    by_hand = 0.5 * math.log(2) + 0.25 * math.log(1 / 2) + 0.25 * math.log(1)
    # The epsilon of 1e-6 moves each logarithm by at most 4e-6.
    assert kl(generated, test) == pytest.approx(by_hand, abs=4e-6)
    assert kl(test, test) == 0


def test_reconstruction_scores_weigh_every_true_object_alike():
    one = (of_classes("desk"), of_classes("desk"))
    three = (of_classes("desk", "sofa"), of_classes("desk", "desk", "table"))
    scores = reconstruction_scores([one, three])
    assert scores["class_accuracy"] == pytest.approx(2 / 4)
    assert scores["box_iou_3d"] == pytest.approx(3 / 4)
    assert scores["count_accuracy"] == 0.5
    assert (scores["rooms"], scores["objects"]) == (2, 4)
    assert reconstruction_scores([])["box_iou_3d"] is None


def test_pairs_of_boxes_by_hand():
    # Cubes at 0, 0.5 and 5, and one off a corner of the third.
    scene = room(
        ("desk", (0, 0.5, 0)), ("chair", (0.5, 0.5, 0)), ("sofa", (5, 0.5, 0)),
        ("stool", (7.5, 0.5, 3)),
    )  # fmt: skip
    pairs = box_pairs(scene.centers_m, scene.sizes_m)
    assert np.transpose(pairs.rows)[intersecting(pairs)].tolist() == [[0, 1]]
    assert pairs.volumes_m3.tolist() == pairs.depths_m.tolist() == [0.5, 0, 0, 0, 0, 0]
    np.testing.assert_allclose(pairs.gaps_m[[0, 1, 5]], [0, 4, 2.5])
    grazing = room(("sofa", (5, 0.5, 0)), ("stool", (5.995, 0.5, 0)))
    pairs = box_pairs(grazing.centers_m, grazing.sizes_m)
    # They share half a percent, so only the depth tells: 5 mm.
    assert not intersecting(pairs).any()
    np.testing.assert_allclose(pairs.depths_m, [0.005], atol=1e-12)


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


def bedroom(gap: float) -> Scene:
    """A bed of 1 m, and a nightstand beside it."""
    return room(("double_bed", (0, 0.5, 0)), ("nightstand", (1 + gap, 0.5, 0)))


def test_the_distance_is_scipys_for_all_weightings_at_once(rng):
    a, b = rng.uniform(0, 3, 12), rng.uniform(1, 3, 7)
    weights_a, weights_b = rng.integers(0, 3, (5, 12)), rng.integers(1, 3, (5, 7))
    got = wasserstein(a, b, weights_a, weights_b)
    for row, weights in enumerate(zip(weights_a, weights_b, strict=True)):
        assert got[row] == pytest.approx(wasserstein_distance(a, b, *weights), abs=1e-12)
    assert np.isnan(wasserstein(a, b, np.zeros((1, 12), int), np.ones((1, 7), int)))


NOVELTY = {metric.key: metric.function for metric in METRICS if metric.key.startswith("near")}
LABELS = ("desk", "chair", "sofa")


@pytest.fixture
def training(rng) -> list[Scene]:
    """Thirty rooms of three pieces; two kinds of furnishing, so that many hold the same."""
    rooms = [
        room(*((label, rng.uniform(-2, 2, 3)) for label in (*LABELS[: 2 + row % 2], "bookshelf")))
        for row in range(30)
    ]
    return [replace(scene, name=f"room_{row}") for row, scene in enumerate(rooms)]


def nudged(scenes, metres) -> list[Scene]:
    def moved(item):
        return replace(item, center_m=(item.center_m[0] + metres, *item.center_m[1:]))

    return [replace(s, name="new", objects=tuple(map(moved, s.objects))) for s in scenes]


def test_a_copy_of_what_the_prior_remembers_is_one_though_the_true_room_is_far(training):
    decoded = [replace(s, name=t.name) for s, t in zip(nudged(training, 5), training, strict=True)]
    threshold = near_copy_threshold(training)
    comparison = compared_with(
        room_set(training[:2]), train=training, decoded=decoded, near_copy_m=threshold
    )
    copies = nudged(decoded, 0.01)
    found = NOVELTY["nearest_decoded_m"](room_set(copies), comparison)
    assert found.value == pytest.approx(0.01)
    # One object added or left out does not make another room; two do.
    for objects, share in (
        (lambda s: s.objects, 1),
        (lambda s: (*s.objects, s.objects[0]), 1),
        (lambda s: s.objects[1:], 1),
        (lambda s: (*s.objects, *s.objects[:2]), 0),
    ):
        changed = room_set([replace(s, objects=objects(s)) for s in copies])
        assert NOVELTY["near_copy_share"](changed, comparison).value == share
    # A training room is compared with the others: one in a hundred lies below the threshold.
    real = NOVELTY["near_copy_share"](room_set(training), comparison)
    assert threshold > 0 and real.value <= 1 / 30
    assert near_copy_threshold(training[:1]) == 0  # nothing is nearer than that
    # Where no two rooms hold the same furniture, nothing can be a copy of another.
    assert near_copy_threshold([training[0], of_classes("sofa", "stool", "wardrobe")]) == 0
