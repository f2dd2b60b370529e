"""Intersections of boxes, by hand."""

import numpy as np
import pytest
from toy_metrics import compared_with, of_classes, room, room_set

from sceneprior.core.classes import label_set
from sceneprior.evaluation.metrics import METRICS
from sceneprior.evaluation.metrics.overlaps import plausible_pairs, room_overlaps

KEYS = (
    "implausible_pairs",
    "deep_pairs",
    "implausible_litres",
    "plausible_pairs",
    "overlap_volume_m3",
)
FUNCTIONS = {metric.key: metric.function for metric in METRICS if metric.key in KEYS}
CLASSES = label_set("front3d_bedroom")
UNDER = room(("desk", (0, 0.5, 0)), ("chair", (0.5, 0.5, 0)))
BESIDE = room(("desk", (0, 0.5, 0)), ("chair", (2, 0.5, 0)))


def intersecting(scene) -> int:
    return room_overlaps(scene).intersect.sum()


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


def test_depth_is_the_shortest_way_out():
    # A small box 0.2 m inside the left side of a large one leaves it by 0.3 m, not through it.
    inside = room(("desk", (0, 0, 0)), ("stool", (-1.75, 0, 0)), sizes=[(4, 4, 4), (0.1, 0.1, 0.1)])
    np.testing.assert_allclose(room_overlaps(inside).depths_m, [0.3], atol=1e-12)
    assert room_overlaps(BESIDE).depths_m.tolist() == [0.0]


def test_pairs_that_share_a_sliver_are_deep_where_they_reach_in_by_a_centimetre():
    """A rule of 1% of the volume lets beds stand 1 cm in wardrobes; these two do not."""
    sizes = [(2.0, 0.5, 2.0), (1.0, 2.0, 0.6)]
    apart = room(("double_bed", (0, 0.25, 0)), ("wardrobe", (1.51, 1.0, 0)), sizes=sizes)
    nudged = room(("double_bed", (0, 0.25, 0)), ("wardrobe", (1.488, 1.0, 0)), sizes=sizes)
    comparison = compared_with(room_set([apart], []))
    found = [
        {
            key: function(room_set([scene], []), comparison).value
            for key, function in FUNCTIONS.items()
        }
        for scene in (apart, nudged)
    ]
    assert [each["implausible_pairs"] for each in found] == [0, 0]
    assert [each["deep_pairs"] for each in found] == [0, 1]
    assert found[1]["implausible_litres"] == pytest.approx(0.012 * 0.5 * 0.6 * 1000)


def test_a_small_box_inside_a_large_one_intersects_and_touching_ones_do_not():
    inside = room(("desk", (0, 1, 0)), ("stool", (0, 1, 0)), sizes=[(4, 2, 4), (0.1, 0.1, 0.1)])
    assert intersecting(inside) == 1
    touching = room(("desk", (0, 0.5, 0)), ("stool", (1, 0.5, 0)))
    assert intersecting(touching) == 0
    assert intersecting(of_classes()) == 0


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
    pairs = found["plausible_pairs"].value + found["implausible_pairs"].value
    assert pairs == np.mean([intersecting(scene) for scene in drawn])
