"""Pictures of views: masks, boxes, wires and the plan where they belong."""

import numpy as np
import pytest
from front_jobs import bedroom_shards

from data_prep.front.viewpoints import camera_pose
from data_prep.inspection.agreement import NEAR_M
from data_prep.inspection.pictures import (
    AXES,
    BACKGROUND,
    FLOOR,
    WALL,
    draw_plan,
    draw_view,
    wire_pixels,
)  # fmt: skip
from sceneprior.core.boxes import BOX_EDGES, box_corners
from sceneprior.core.shards import Shard, list_shards

K = np.array([[100.0, 0, 60], [0, 100, 45], [0, 0, 1]])


def test_wires_join_projected_points(numbers):
    camera = camera_pose(np.array([0.3, 1.5, -3.0]), 0.2, 0.3)
    points = box_corners(numbers.normal(size=3) * 0.2, np.array([1.0, 0.5, 0.8]))
    here = points @ camera[:3, :3].T + camera[:3, 3]
    pixels = here @ K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    for line, (a, b) in zip(wire_pixels(points, BOX_EDGES, camera, K), BOX_EDGES, strict=True):
        np.testing.assert_allclose(line, [*pixels[a], *pixels[b]], atol=1e-5)  # rounded to 1e-6


@pytest.mark.parametrize("turned", [False, True])
def test_a_line_through_the_camera_is_cut_where_it_becomes_visible(turned):
    line = np.array([[0.0, 0.1, -2.0], [0.0, 0.1, 2.0]])[:: -1 if turned else 1]
    ((u1, v1, u2, v2),) = wire_pixels(line, [(0, 1)], np.eye(4), K)
    ends = [(u1, v1), (u2, v2)][:: -1 if turned else 1]
    assert ends[0] == pytest.approx((60, 45 + 100 * 0.1 / NEAR_M))
    assert ends[1] == pytest.approx((60, 50))
    assert wire_pixels(-np.abs(line), [(0, 1)], np.eye(4), K) == []


@pytest.fixture
def shard(made_once):
    with Shard(list_shards(made_once("bedroom", bedroom_shards), "train")[0]) as opened:
        yield opened


def best_view(room):
    return int(room.visible.sum(axis=1).argmax())


def test_black_wires_lie_on_the_projected_edges(shard):
    (room_id,) = shard.room_ids
    room, truth = shard.read_room(room_id), shard.read_ground_truth(room_id)
    view = best_view(room)
    with_wires = np.asarray(draw_view(shard, room_id, view, True, 480)).astype(int)
    without = np.asarray(draw_view(shard, room_id, view, False, 480)).astype(int)
    assert with_wires.shape == (360, 480, 3)
    different = (with_wires != without).any(axis=2)
    lens = np.diag([4.0, 4, 1]) @ room.intrinsics[view]
    on = []
    for k in np.flatnonzero(room.visible[view]):
        corners = box_corners(truth.centers_m[k], truth.sizes_m[k])
        for u1, v1, u2, v2 in wire_pixels(corners, BOX_EDGES, room.world_to_camera[view], lens):
            for share in np.linspace(0.1, 0.9, 30):
                u, v = int(u1 + share * (u2 - u1)), int(v1 + share * (v2 - v1))
                if 2 < u < 477 and 2 < v < 357:
                    on.append(different[v - 1 : v + 2, u - 1 : u + 2].any())
    assert len(on) > 100 and np.mean(on) > 0.8  # frames and names cover the rest
    assert 0 < different.mean() < 0.2


def test_masks_have_their_class_colours_and_the_floor_is_a_grid(shard):
    (room_id,) = shard.room_ids
    view = best_view(shard.read_room(room_id))
    picture = np.asarray(draw_view(shard, room_id, view, True, 120))
    ids = shard.read_instance_ids(room_id, [view])[0]
    assert picture.shape == (*ids.shape, 3)
    plain = (picture == BACKGROUND).all(axis=2)
    assert plain[ids == 0].mean() > 0.5 and plain[ids > 0].mean() < 0.05


def test_the_plan_shows_every_piece_from_above(shard):
    (room_id,) = shard.room_ids
    truth = shard.read_ground_truth(room_id)
    plan = np.asarray(draw_plan(shard, room_id, 480, 360)).astype(int)
    assert plan.shape == (360, 480, 3)
    # 4 x 4 m of floor and 0.4 m around, so 360 / 4.8 = 75 pixels a metre; the origin in the middle.
    for k in range(len(truth.centers_m)):
        x, _, z = truth.centers_m[k] + truth.sizes_m[k] * 0.3  # beside bar and name
        assert not (plan[round(180 + 75 * z), round(240 + 75 * x)] == BACKGROUND).all()
    assert (plan == AXES["x"]).all(axis=2).any() and (plan == AXES["z"]).all(axis=2).any()
    # The floor is seen, and its only wall, at z = -2; both reach from x = -2 to 2.
    assert (plan == FLOOR).all(axis=2).mean() > 0.1
    rows, columns = np.nonzero((plan == WALL).all(axis=2))
    assert len(rows) > 50 and np.abs(rows - (180 - 150)).max() <= 4
    assert columns.min() >= 240 - 154 and columns.max() <= 240 + 154
