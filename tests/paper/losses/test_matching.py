"""2D boxes of predictions, and Hungarian matching against trying every permutation."""

from dataclasses import replace

import pytest
import torch
from references.losses import best_assignment, pair_cost
from refusals import refused
from torch.testing import assert_close

from sceneprior.core.cameras import boxes_of_points
from sceneprior.core.proxies import beveled_cube, boxes_of_ellipsoids, place
from sceneprior.paper.matching import match_objects, matching_cost, seen_boxes

OVERSHOOT = (1.0, 0.3, 0.0)


def costs_by_hand(batch, room, overshoot, box_weight=5.0):
    views, scenes = batch.views, batch.scenes
    return [
        [
            pair_cost(
                scenes.class_logits[room, slot].tolist(),
                batch.boxes.boxes[room, :, slot].tolist(),
                int(views.object_class[room, item]),
                views.boxes[room, :, item].tolist(),
                views.visible[room, :, item].tolist(),
                views.sides_clear[room, :, item].tolist(),
                box_weight,
                overshoot,
            )
            for item in range(views.is_object.shape[1])
        ]
        for slot in range(scenes.class_logits.shape[1])
    ]


@pytest.mark.parametrize("overshoot", OVERSHOOT)
def test_costs_are_the_papers_pair_by_pair(batch, overshoot):
    for weight in (5.0, 0.0):
        found = matching_cost(batch.scenes, batch.boxes, batch.views, weight, overshoot)
        for room in range(3):
            by_hand = torch.tensor(costs_by_hand(batch, room, overshoot, weight)).double()
            # What padding costs is never asked.
            count = int(batch.views.is_object[room].sum())
            assert_close(found[room, :, :count], by_hand[:, :count], rtol=0, atol=1e-6)


@pytest.mark.parametrize("overshoot", OVERSHOOT)
def test_no_permutation_is_cheaper(batch, overshoot):
    matches = match_objects(batch.scenes, batch.boxes, batch.views, 5.0, overshoot)
    for room, count in enumerate(batch.views.is_object.sum(dim=1).tolist()):
        cost = [row[:count] for row in costs_by_hand(batch, room, overshoot)[:count]]
        best, total = best_assignment(cost)
        mine = matches.prediction[room, :count].tolist()
        # One-to-one onto the first n predictions alone, though there are five.
        assert sorted(mine) == list(range(count))
        assert sum(cost[row][item] for item, row in enumerate(mine)) == pytest.approx(total)
        seen = batch.views.visible[room, :, :count].any(dim=0).tolist()
        for item in range(count):
            if seen[item] and all(seen):
                assert mine[item] == best[item]


def test_the_first_n_predictions_are_used_even_if_a_later_one_is_perfect(batch):
    """Room 1 has two objects; prediction 4 is made to fit the first of them exactly."""
    boxes = batch.boxes.boxes.clone()
    boxes[1, :, 4] = batch.views.boxes[1, :, 0]
    matches = match_objects(batch.scenes, batch.boxes._replace(boxes=boxes), batch.views)
    assert set(matches.prediction[1, :2].tolist()) == {0, 1}


def test_objects_that_no_drawn_view_sees_and_padding_match_nothing(batch):
    matches = match_objects(batch.scenes, batch.boxes, batch.views)
    assert torch.equal(matches.valid, batch.views.is_object & batch.views.visible.any(dim=1))
    assert not matches.valid[2, 1] and not matches.valid[1, 2:].any()
    assert (matches.prediction[1, 2:] == 0).all()
    # Whatever they are said to be, the others are matched as before.
    classes = batch.views.object_class.clone()
    classes[2, 1] = (classes[2, 1] + 1) % 6
    again = match_objects(batch.scenes, batch.boxes, replace(batch.views, object_class=classes))
    assert torch.equal(again.prediction, matches.prediction)


def test_more_objects_than_slots_says_what_to_set(batch):
    scenes = batch.scenes
    few = replace(
        scenes,
        class_logits=scenes.class_logits[:, :3],
        centers_m=scenes.centers_m[:, :3],
        sizes_m=scenes.sizes_m[:, :3],
        completeness_logits=scenes.completeness_logits[:, :3],
    )
    boxes = type(batch.boxes)(batch.boxes.boxes[:, :, :3], batch.boxes.in_frustum[:, :, :3])
    with refused("paper/more objects than predictions", ValueError):
        match_objects(few, boxes, batch.views)


@pytest.mark.parametrize(
    ("proxy", "box_from"), [("ellipsoid", "proxy"), ("beveled_box", "proxy"), ("ellipsoid", "mesh")]
)
def test_boxes_are_those_of_mesh_or_proxy_for_the_matched_predictions_alone(
    batch, torch_rng, proxy, box_from
):
    views, placed = batch.views, (batch.scenes.centers_m, batch.scenes.sizes_m)
    bevels = torch.rand(3, 5, 2, generator=torch_rng, dtype=torch.float64)
    meshes = torch.rand(3, 5, 9, 3, generator=torch_rng, dtype=torch.float64)
    scenes = replace(batch.scenes, bevels=bevels, vertices_m=meshes)
    found = seen_boxes(scenes, views, proxy, box_from)
    cameras = (views.world_to_camera, views.intrinsics, views.image_size)
    if box_from == "mesh":
        wanted = boxes_of_points(meshes, *cameras)
        without = seen_boxes(replace(scenes, vertices_m=None), views, proxy, box_from)
        assert torch.equal(without.boxes, seen_boxes(scenes, views, proxy).boxes)
    elif proxy == "ellipsoid":
        wanted = boxes_of_ellipsoids(*placed, *cameras)
    else:
        wanted = boxes_of_points(place(beveled_cube(bevels), *placed), *cameras)
    for room, count in enumerate(views.is_object.sum(dim=1).tolist()):
        for some, every in zip(found, wanted, strict=True):
            # The same operations on other strides: the last bits may differ.
            assert_close(some[room, :, :count], every[room, :, :count], rtol=0, atol=1e-12)
            assert not some[room, :, count:].any()
    assert found.in_frustum.any()
