"""IoU and matching of boxes: by hand, on a grid, and against trimesh."""

import itertools

import numpy as np
import pytest
from toy_metrics import of_classes, room

from sceneprior.core.overlaps import box_iou_3d, match_scenes
from sceneprior.evaluation.metrics.contents import reconstruction_scores


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
    flat = np.array([[1.0, 0, 1]])
    assert box_iou_3d(centers[:1], flat, centers[:1], flat)[0, 0] == 0


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
