"""Intersections of boxes, by hand."""

from toy_metrics import of_classes, room

from sceneprior.evaluation.metrics.overlaps import overlap_pairs, room_overlaps


def test_overlaps_by_hand():
    # Cubes at 0, 0.5 and 5; a fourth shares 0.5% with the third; a void one inside the first.
    scene = room(
        ("desk", (0, 0.5, 0)), ("chair", (0.5, 0.5, 0)), ("sofa", (5, 0.5, 0)),
        ("stool", (5.995, 0.5, 0)), ("void", (0, 0.5, 0)),
    )  # fmt: skip
    assert overlap_pairs([scene, of_classes("desk")]) == 0.5
    assert room_overlaps(scene)[:2] == (1, 6)


def test_a_small_box_inside_a_large_one_intersects_and_touching_ones_do_not():
    inside = room(("desk", (0, 1, 0)), ("stool", (0, 1, 0)), sizes=[(4, 2, 4), (0.1, 0.1, 0.1)])
    assert overlap_pairs([inside]) == 1
    touching = room(("desk", (0, 0.5, 0)), ("stool", (1, 0.5, 0)))
    assert overlap_pairs([touching]) == 0
    assert overlap_pairs([]) == overlap_pairs([of_classes()]) == 0
