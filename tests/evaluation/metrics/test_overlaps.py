"""Intersections of boxes, by hand."""

import numpy as np
from toy_metrics import compared_with, of_classes, room, room_set

from sceneprior.classes import label_set
from sceneprior.evaluation.metrics.overlaps import (
    METRICS,
    overlap_pairs,
    plausible_pairs,
    room_overlaps,
)

FUNCTIONS = {metric.key: metric.function for metric in METRICS}
CLASSES = label_set("front3d_bedroom")
UNDER = room(("desk", (0, 0.5, 0)), ("chair", (0.5, 0.5, 0)))
BESIDE = room(("desk", (0, 0.5, 0)), ("chair", (2, 0.5, 0)))


def test_overlaps_by_hand():
    # Cubes at 0, 0.5 and 5; a fourth shares 0.5% with the third; a void one inside the first.
    scene = room(
        ("desk", (0, 0.5, 0)), ("chair", (0.5, 0.5, 0)), ("sofa", (5, 0.5, 0)),
        ("stool", (5.995, 0.5, 0)), ("void", (0, 0.5, 0)),
    )  # fmt: skip
    assert overlap_pairs([scene, of_classes("desk")]) == 0.5
    pair = sorted((CLASSES.index("desk"), CLASSES.index("chair")))
    assert room_overlaps(scene).hits.tolist() == [pair]


def test_a_small_box_inside_a_large_one_intersects_and_touching_ones_do_not():
    inside = room(("desk", (0, 1, 0)), ("stool", (0, 1, 0)), sizes=[(4, 2, 4), (0.1, 0.1, 0.1)])
    assert overlap_pairs([inside]) == 1
    touching = room(("desk", (0, 0.5, 0)), ("stool", (1, 0.5, 0)))
    assert overlap_pairs([touching]) == 0
    assert overlap_pairs([]) == overlap_pairs([of_classes()]) == 0


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


def test_the_split_of_pairs_is_what_real_rooms_do(rng):
    comparison = compared_with(room_set([UNDER], []), plausible_pairs=plausible_pairs([UNDER]))
    bed_in_desk = ("double_bed", (0.0, 0.5, 0.4))
    drawn = [room(*((o.label, o.center_m) for o in UNDER.objects), bed_in_desk), BESIDE]
    found = {key: function(room_set(drawn, []), comparison) for key, function in FUNCTIONS.items()}
    assert found["plausible_pairs"].value == 0.5  # the chair in the desk
    assert found["implausible_pairs"].value == 1.0  # the bed in the desk and in the chair
    assert found["plausible_pairs"].value + found["implausible_pairs"].value == overlap_pairs(drawn)
    # Turned rooms and rooms whose objects stand in another order have the same.
    turned = [
        room(*((o.label, (o.center_m[2], 0.5, -o.center_m[0])) for o in scene.objects[::-1]))
        for scene in drawn
    ]
    for key, function in FUNCTIONS.items():
        assert np.isclose(function(room_set(turned, []), comparison).value, found[key].value)
