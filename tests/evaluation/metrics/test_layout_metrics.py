"""Layout figures by hand."""

import itertools
import math

import numpy as np
import pytest
import trimesh

from sceneprior.errors import InputError
from sceneprior.evaluation.metrics.layout_metrics import (
    box_iou_3d,
    category_kl,
    class_frequencies,
    match_scenes,
    object_counts,
    overlap_pairs,
    reconstruction_scores,
    type_share,
)
from sceneprior.scene import Scene, SceneObject

UNIT = (1.0, 1.0, 1.0)


def room(*items: tuple[str, tuple[float, float, float]], sizes=None) -> Scene:
    sizes = sizes or [UNIT] * len(items)
    objects = [
        SceneObject(label, tuple(map(float, at)), tuple(map(float, size)))
        for (label, at), size in zip(items, sizes, strict=True)
    ]
    return Scene("room", "front3d_bedroom", tuple(objects))


def of_classes(*labels: str) -> Scene:
    return room(*((label, (3.0 * index, 0.5, 0.0)) for index, label in enumerate(labels)))


def test_category_kl_by_hand():
    test = [of_classes("double_bed", "nightstand"), of_classes("double_bed", "desk", "void")]
    generated = [of_classes("double_bed", "nightstand", "nightstand", "desk"), of_classes("void")]
    # test: bed 1/2, nightstand 1/4, desk 1/4; generated: 1/4, 1/2, 1/4
    by_hand = 0.5 * math.log(2) + 0.25 * math.log(1 / 2) + 0.25 * math.log(1)
    # The epsilon of 1e-6 moves each logarithm by at most 4e-6.
    assert category_kl(generated, test) == pytest.approx(by_hand, abs=4e-6)
    assert category_kl(test, test) == 0


def test_a_class_never_generated_costs_the_epsilon_not_infinity():
    test, generated = [of_classes("desk", "sofa")], [of_classes("desk")]
    by_hand = 0.5 * math.log((0.5 + 1e-6) / (1 + 1e-6)) + 0.5 * math.log((0.5 + 1e-6) / 1e-6)
    assert category_kl(generated, test) == pytest.approx(by_hand, abs=1e-12)
    assert math.isfinite(category_kl([of_classes()], test))


def test_scenes_of_different_label_sets_are_not_compared():
    living = Scene("a", "front3d_living", ())
    with pytest.raises(InputError, match="label sets front3d_bedroom, front3d_living came"):
        category_kl([living], [of_classes("desk")])
    with pytest.raises(InputError, match="no scenes came"):
        class_frequencies([])


def test_counts_and_type_share_leave_void_out():
    scenes = [of_classes("kids_bed", "void"), of_classes("desk"), of_classes()]
    assert object_counts(scenes).tolist() == [1, 1, 0]
    assert type_share(scenes) == pytest.approx(1 / 3)
    assert type_share([Scene("a", "scannet", ())]) is None
    assert type_share([]) is None


def test_overlaps_by_hand():
    # Cubes at 0, 0.5 and 5; a fourth shares 0.5% with the third; a void one inside the first.
    scene = room(
        ("desk", (0, 0.5, 0)), ("chair", (0.5, 0.5, 0)), ("sofa", (5, 0.5, 0)),
        ("stool", (5.995, 0.5, 0)), ("void", (0, 0.5, 0)),
    )  # fmt: skip
    overlaps = overlap_pairs([scene, of_classes("desk")])
    assert overlaps.per_room == 0.5
    assert overlaps.share == pytest.approx(1 / 6)


def test_a_small_box_inside_a_large_one_intersects_and_touching_ones_do_not():
    inside = room(("desk", (0, 1, 0)), ("stool", (0, 1, 0)), sizes=[(4, 2, 4), (0.1, 0.1, 0.1)])
    assert overlap_pairs([inside]).per_room == 1
    touching = room(("desk", (0, 0.5, 0)), ("stool", (1, 0.5, 0)))
    assert overlap_pairs([touching]).per_room == 0
    assert overlap_pairs([]).per_room == overlap_pairs([of_classes()]).share == 0


def test_iou_by_hand():
    centers = np.array([[0.0, 0, 0], [0.5, 0, 0], [0.5, 0.5, 0.5], [2, 0, 0], [0, 0, 0]])
    sizes = np.array([[1.0, 1, 1]] * 4 + [[0.5, 0.5, 0.5]])
    iou = box_iou_3d(centers[:1], sizes[:1], centers, sizes)
    # same; half shared: 0.5 / 1.5; an eighth: 0.125 / 1.875; apart; inside: 0.125 / 1
    np.testing.assert_allclose(iou, [[1, 1 / 3, 1 / 15, 0, 0.125]], atol=1e-15)
    flat = np.array([[1.0, 0, 1]])
    assert box_iou_3d(centers[:1], flat, centers[:1], flat)[0, 0] == 0


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


def test_unions_agree_with_trimesh_volumes():
    box = trimesh.creation.box(extents=(1.2, 0.7, 2.0))
    center, size = np.zeros((1, 3)), box.extents[None]
    shifted = box_iou_3d(center, size, center + 0.2, size)
    shared = np.prod(box.extents - 0.2)
    assert shifted[0, 0] == pytest.approx(shared / (2 * box.volume - shared), abs=1e-12)


def test_matching_ignores_order_and_class():
    truth = room(("desk", (0, 0.5, 0)), ("sofa", (3, 0.5, 0)), ("table", (6, 0.5, 0)))
    decoded = room(("sofa", (6, 0.5, 0)), ("sofa", (3.5, 0.5, 0)), ("desk", (0, 0.5, 0)))
    match = match_scenes(decoded, truth)
    pairs = dict(zip(match.decoded.tolist(), match.truth.tolist(), strict=True))
    assert pairs == {0: 2, 1: 1, 2: 0}
    assert match.class_accuracy == pytest.approx(2 / 3)
    assert match.mean_iou == pytest.approx((1 + 1 / 3 + 1) / 3)


def test_unmatched_objects_count_as_wrong_and_far_ones_go_to_the_nearest():
    truth = room(("desk", (0, 0.5, 0)), ("sofa", (9, 0.5, 0)))
    match = match_scenes(room(("sofa", (7, 0.5, 0))), truth)
    assert match.truth.tolist() == [1]
    assert match.class_accuracy == 0.5 and match.mean_iou == 0
    assert match_scenes(of_classes(), truth).class_accuracy == 0
    assert match_scenes(truth, of_classes()).class_accuracy is None


def test_reconstruction_scores_weigh_every_true_object_alike():
    one = (of_classes("desk"), of_classes("desk"))
    three = (of_classes("desk", "sofa"), of_classes("desk", "desk", "table"))
    scores = reconstruction_scores([one, three])
    assert scores["class_accuracy"] == pytest.approx(2 / 4)
    assert scores["box_iou_3d"] == pytest.approx(3 / 4)
    assert scores["count_accuracy"] == 0.5
    assert (scores["rooms"], scores["objects"]) == (2, 4)
    assert reconstruction_scores([])["box_iou_3d"] is None
