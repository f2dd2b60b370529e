"""Gaps between classes by hand, the distance against SciPy's, and rooms whose objects part."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import wasserstein_distance
from toy_metrics import compared_with, of_classes, room, room_set

from sceneprior.core.classes import label_set
from sceneprior.evaluation.metrics import METRICS
from sceneprior.evaluation.metrics.relations import (
    FAR_M,
    common_pairs,
    furthest_pairs,
    nearest_gaps,
    wasserstein,
)

CLASSES = label_set("front3d_bedroom")
BED, STAND, CHAIR = (CLASSES.index(name) for name in ("double_bed", "nightstand", "chair"))
FUNCTIONS = {metric.key: metric.function for metric in METRICS}


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


def compared(test, real):
    comparison = compared_with(room_set(test, []), real=real)
    train = {
        "relation_distance_m": FUNCTIONS["relation_distance_m"](room_set(real, []), comparison)
    }
    comparison.columns["train_rooms"] = train
    return comparison


def test_common_pairs_weigh_more_and_the_table_begins_with_what_is_off_most():
    """Ten nightstands 1 m off and one chair 2 m off its desk: 20 gaps and 2."""
    desk = [("desk", (0, 0.5, 0)), ("chair", (1, 0.5, 0))]
    real = [bedroom(0.0)] * 10 + [room(*desk)]
    comparison = compared(real, real)
    off = room_set([bedroom(1.0)] * 10 + [room(desk[0], ("chair", (3, 0.5, 0)))], [])
    distance = FUNCTIONS["relation_distance_m"](off, comparison).value
    assert distance == pytest.approx((20 * 1.0 + 2 * 2.0) / 22)
    pairs = [(row["of"], row["to"]) for row in furthest_pairs(off, room_set(real, []), comparison)]
    assert pairs[0] in (("nightstand", "double_bed"), ("double_bed", "nightstand"))
    assert len(pairs) == 4
