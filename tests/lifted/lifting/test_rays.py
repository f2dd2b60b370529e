"""Rays through masks: what each says holds in the true room."""

from dataclasses import replace

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


def test_an_object_that_no_view_shows_has_rays_that_tell_nothing(room):
    views, _ = room
    visible = views.visible.copy()
    visible[:, 0] = False
    unseen = replace(views, visible=visible)
    pool = draw_rays(unseen, lift_boxes(unseen), 20, MARGIN)
    assert not pool.spans[0].any() and not pool.hits[0].any()
    assert pool.spans[1].any()


def test_a_view_that_shows_nothing_of_an_object_is_not_drawn_from(room):
    views, _ = room
    boxes = lift_boxes(views)
    visible = views.visible.copy()
    visible[1:, 0] = False
    pool = draw_rays(replace(views, visible=visible), boxes, 50, MARGIN)
    scale = MARGIN * boxes.sizes_m[0] / 2
    camera = -views.world_to_camera[0, :3, :3].T @ views.world_to_camera[0, :3, 3]
    starts = pool.starts[0] * scale + boxes.centers_m[0]
    known = np.abs(pool.spans[0]).max(axis=1) > 0
    away = np.cross(starts - camera, pool.spans[0] * scale)[known]
    np.testing.assert_allclose(away, 0, rtol=0, atol=1e-4)


def test_passing_a_box_from_outside_inside_beside_and_along_a_side():
    low, high = np.zeros(3), np.ones(3)
    origins = np.array([[-1, 0.5, 0.5], [0.5, 0.5, 0.5], [-1, 2, 0.5], [-1, 0, 0.5], [2, 0.5, 0.5]])
    near, far = pass_through(origins, np.tile([1.0, 0, 0], (5, 1)), low, high)
    assert near[:2].tolist() == [1, 0] and far[:2].tolist() == [2, 0.5]
    assert far[2] <= near[2] and (near[3], far[3]) == (1, 2) and far[4] <= near[4]


def test_a_room_without_tracked_objects_has_neither_boxes_nor_rays(room):
    views, _ = room
    bare = replace(
        views, object_class=views.object_class[:0], boxes=views.boxes[:, :0],
        visible=views.visible[:, :0], mask_pixels=views.mask_pixels[:, :0],
        sides_clear=views.sides_clear[:, :0], instance_ids=views.instance_ids * 0,
    )  # fmt: skip
    boxes = lift_boxes(bare)
    assert boxes.centers_m.shape == boxes.sizes_m.shape == (0, 3) and boxes.explained.shape == (0,)
    assert draw_rays(bare, boxes, 5, MARGIN).hits.shape == (0, 5)
