"""Copies are told from rooms that are as new as real ones."""

from dataclasses import replace

import numpy as np
import pytest
from toy_metrics import compared_with, of_classes, room, room_set

from sceneprior.core.scene import Scene
from sceneprior.evaluation.metric import Comparison
from sceneprior.evaluation.metrics import METRICS
from sceneprior.evaluation.metrics.novelty import near_copy_threshold

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
