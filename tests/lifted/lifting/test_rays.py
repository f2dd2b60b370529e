"""Rays through masks: what each says holds in the true room."""

import numpy as np
import pytest

from sceneprior.core.shards import iterate_rooms
from sceneprior.lifted.lifting.boxes import draw_rays, lift_boxes
from sceneprior.lifted.lifting.hulls import pass_through


@pytest.fixture(scope="module")
def room(toy_shards):
    return next(
        (shard.read_room(room_id, images=True), shard.read_ground_truth(room_id))
        for shard, room_id in iterate_rooms(toy_shards, "train")
    )


MARGIN = 1.2


def test_a_hit_meets_the_true_box_and_a_span_without_one_is_empty(room):
    """Toy furniture fills its boxes. A ray is cast from a pixel's centre, and so was the id."""
    views, truth = room
    boxes = lift_boxes(views)
    pool = draw_rays(views, boxes, 300, MARGIN)
    for item in np.flatnonzero(boxes.explained > 0):
        scale = MARGIN * boxes.sizes_m[item] / 2
        spans = pool.spans[item] * scale
        length = np.linalg.norm(spans, axis=1)
        known = length > 0
        center_m, half_m = truth.centers_m[item].astype(float), truth.sizes_m[item] / 2.0
        near, far = pass_through(
            (pool.starts[item] * scale + boxes.centers_m[item])[known],
            spans[known] / length[known, None],
            center_m - half_m, center_m + half_m,
        )  # fmt: skip
        entered = np.where(far > near, near, np.inf)
        hits = pool.hits[item][known]
        assert 0.1 < hits.mean() < 0.9, "rays teach both ways"
        met = entered <= length[known] + 1e-3
        assert met[hits].mean() > 0.97 and (~met[~hits]).mean() > 0.97


def test_passing_a_box_from_outside_inside_beside_and_along_a_side():
    low, high = np.zeros(3), np.ones(3)
    origins = np.array([[-1, 0.5, 0.5], [0.5, 0.5, 0.5], [-1, 2, 0.5], [-1, 0, 0.5], [2, 0.5, 0.5]])
    near, far = pass_through(origins, np.tile([1.0, 0, 0], (5, 1)), low, high)
    assert near[:2].tolist() == [1, 0] and far[:2].tolist() == [2, 0.5]
    assert far[2] <= near[2] and (near[3], far[3]) == (1, 2) and far[4] <= near[4]
