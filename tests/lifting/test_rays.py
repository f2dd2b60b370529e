"""Rays through masks: what each says holds in the true room."""

from dataclasses import replace

import numpy as np
import pytest

from sceneprior.lifting.boxes import lift_boxes
from sceneprior.lifting.hulls import pass_through
from sceneprior.lifting.rays import FAR_M, FRAME, draw_rays, entry_m
from sceneprior.shards import iterate_rooms


@pytest.fixture(scope="module")
def room(toy_shards):
    return next(
        (shard.read_room(room_id, images=True), shard.read_ground_truth(room_id))
        for shard, room_id in iterate_rooms(toy_shards, "train")
    )


def test_a_hit_meets_the_true_box_and_a_stretch_without_one_is_empty(room):
    """Toy furniture fills its boxes. A ray is cast from a pixel's centre, and so was the id."""
    views, truth = room
    boxes = lift_boxes(views)
    pool = draw_rays(views, boxes, 300)
    for item in np.flatnonzero(boxes.explained > 0):
        entered = entry_m(
            pool.origins_m[item].astype(float), pool.directions[item].astype(float),
            truth.centers_m[item].astype(float), truth.sizes_m[item].astype(float),
        )  # fmt: skip
        hits, until = pool.hits[item], pool.until_m[item]
        assert 0.1 < hits.mean() < 0.9, "rays teach both ways"
        assert np.isfinite(entered[hits]).mean() > 0.99 and (until[hits] == FAR_M).all()
        empty = ~hits & (until > 0)
        assert (entered[empty] >= until[empty]).mean() > 0.99
    np.testing.assert_allclose(np.linalg.norm(pool.directions, axis=-1), 1, rtol=0, atol=1e-6)


def test_rays_pass_the_frame_of_their_object(room):
    views, _ = room
    boxes = lift_boxes(views)
    pool = draw_rays(views, boxes, 100)
    for item in np.flatnonzero(boxes.explained > 0):
        entered = entry_m(
            pool.origins_m[item].astype(float), pool.directions[item].astype(float),
            boxes.centers_m[item], FRAME * boxes.sizes_m[item],
        )  # fmt: skip
        assert (entered < pool.until_m[item] + 1e-5).all()  # float32 origins


def test_half_of_the_rays_are_near_the_outline_and_seeds_decide(room):
    views, _ = room
    boxes = lift_boxes(views)
    first, again = draw_rays(views, boxes, 50, seed=1), draw_rays(views, boxes, 50, seed=1)
    other = draw_rays(views, boxes, 50, seed=2)
    np.testing.assert_array_equal(first.directions, again.directions)
    assert (first.directions != other.directions).any()


def test_an_object_that_no_view_shows_has_rays_that_tell_nothing(room):
    views, _ = room
    visible = views.visible.copy()
    visible[:, 0] = False
    unseen = replace(views, visible=visible)
    pool = draw_rays(unseen, lift_boxes(unseen), 20)
    assert not pool.until_m[0].any() and not pool.hits[0].any()
    assert pool.until_m[1].any()


def test_a_view_without_instances_is_background(room):
    """Nothing in it is an object's own, and its rays are never drawn: no mask is there."""
    views, _ = room
    ids, visible = views.instance_ids.copy(), views.visible.copy()
    ids[0], visible[0] = 0, False
    pool = draw_rays(replace(views, instance_ids=ids, visible=visible), lift_boxes(views), 50)
    camera = -views.world_to_camera[0, :3, :3].T @ views.world_to_camera[0, :3, 3]
    assert (np.abs(pool.origins_m - camera).sum(axis=-1) > 1e-3).all()


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
    assert draw_rays(bare, boxes, 5).until_m.shape == (0, 5)
