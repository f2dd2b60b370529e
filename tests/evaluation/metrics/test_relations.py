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
    pair_distances,
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


def test_nightstands_that_stand_away_are_seen_and_by_how_much(rng):
    real = [bedroom(gap) for gap in rng.uniform(0, 0.2, 40)]
    test = [bedroom(gap) for gap in rng.uniform(0, 0.2, 40)]
    comparison = compared(test, real)
    apart = room_set([bedroom(gap) for gap in rng.uniform(1, 1.2, 40)], [])
    distance = FUNCTIONS["relation_distance_m"](apart, comparison)
    assert distance.value == pytest.approx(1.0, abs=0.05)
    low, high = distance.interval()
    assert low <= distance.value <= high and high - low < 0.1
    floor = comparison.columns["train_rooms"]["relation_distance_m"].value
    assert floor < 0.03
    ratio = FUNCTIONS["relation_ratio"](apart, comparison)
    assert ratio.value == pytest.approx(distance.value / floor)
    rows = furthest_pairs(apart, room_set(real, []), comparison)
    assert {(row["of"], row["to"]) for row in rows} == {
        ("double_bed", "nightstand"), ("nightstand", "double_bed")
    }  # fmt: skip
    assert all((row["near"], row["near_test"]) == (0.0, 1.0) for row in rows)


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


def test_a_set_without_a_pair_gets_no_better_by_it():
    real = [bedroom(0.1)] * 20
    comparison = compared(real, real)
    lonely = room_set([of_classes("double_bed")] * 20, [])
    assert FUNCTIONS["relation_distance_m"](lonely, comparison).value == pytest.approx(FAR_M - 0.1)
    assert furthest_pairs(lonely, lonely, comparison)[0]["near"] is None
    # A pair that the test rooms never have cannot be held against anything.
    none = compared([of_classes("chair")] * 4, real)
    assert pair_distances(lonely, none).pairs == []
    assert FUNCTIONS["relation_distance_m"](lonely, none).value is None


def test_resamples_without_any_pair_are_left_out():
    real = [bedroom(0.1), of_classes("chair")]
    comparison = compared(real, real)
    # Of two rooms, a resample may hold the one without a pair twice.
    few = room_set([bedroom(0.5), of_classes("chair")], [])
    estimate = FUNCTIONS["relation_distance_m"](few, comparison)
    assert estimate.value == pytest.approx(0.4)
    assert np.isfinite(estimate.resamples).all() and 0 < len(estimate.resamples) < 20
