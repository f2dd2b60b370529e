"""Copies are told from rooms that are as new as real ones."""

from dataclasses import replace

import numpy as np
import pytest
from toy_metrics import compared_with, room, room_set

from sceneprior.evaluation.metric import Comparison
from sceneprior.evaluation.metrics.novelty import METRICS, near_copy_threshold
from sceneprior.scene import Scene

FUNCTIONS = {metric.key: metric.function for metric in METRICS}
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


def test_exact_copies_are_all_near_copies_and_real_rooms_are_none(training):
    # Rooms that share no class: as far from each training room as can be.
    test = [room(("stool", (0, 0, 0)), ("wardrobe", (1, 0, 0)))] * 4
    comparison = compared(training, test)
    copies = values(room_set(nudged(training, 0.0), training, training), comparison)
    assert copies["near_copy_share"] == copies["near_copy_excess"] == 1
    assert copies["nearest_training_m"] == copies["nearest_decoded_m"] == 0
    real = values(room_set(training, training, own=True), comparison)
    assert real["near_copy_share"] == real["near_copy_excess"] == 0
    assert real["nearest_training_m"] > comparison.near_copy_m > 0


def test_a_copy_of_what_the_prior_remembers_is_one_though_the_true_room_is_far(training):
    decoded = [replace(s, name=t.name) for s, t in zip(nudged(training, 5), training, strict=True)]
    comparison = compared(training, training[:2])
    drawn = room_set(nudged(decoded, 0.01), training, decoded)
    assert values(drawn, comparison)["near_copy_share"] == 1
    assert values(drawn, comparison)["nearest_decoded_m"] == pytest.approx(0.01)
    # Another piece of furniture makes it another room.
    more = [replace(s, objects=(*s.objects, s.objects[0])) for s in nudged(decoded, 0.01)]
    assert values(room_set(more, training, decoded), comparison)["near_copy_share"] == 0


def test_the_threshold_is_what_one_real_room_in_a_hundred_falls_below(training):
    threshold = near_copy_threshold(training)
    nearest = room_set(training, training, own=True).nearest.training_m
    assert threshold == np.quantile(nearest, 0.01)
    assert near_copy_threshold(training[:1]) == 0  # nothing is nearer than that


def test_the_ratio_is_one_for_real_rooms_and_left_out_where_nothing_is_decoded(training, rng):
    test = nudged(training[:6], 0.7)
    comparison = compared(training, test)
    assert "nearest_decoded_training_ratio" not in values(room_set(test, training), comparison)
    comparison = replace(comparison, test=room_set(test, training, training))
    same = values(room_set(test, training, training), comparison)
    assert same["nearest_decoded_training_ratio"] == 1
    nearer = values(room_set(nudged(training[:6], 0.35), training, training), comparison)
    assert nearer["nearest_decoded_training_ratio"] < 0.8
