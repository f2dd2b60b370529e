"""Intersections of boxes, by hand."""

import numpy as np
from toy_metrics import of_classes, room

from sceneprior.core.classes import label_set
from sceneprior.evaluation.metrics.overlaps import plausible_pairs, room_overlaps

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
