"""Pictures of views: masks, boxes, wires and the plan where they belong."""

import numpy as np
import pytest
from front_jobs import bedroom_shards

from data_prep.front.views import camera_pose
from data_prep.inspection.agreement import NEAR_M, Hull, project_edges
from data_prep.inspection.pictures import AXES, BACKGROUND, FLOOR, WALL, draw_plan, draw_view
from sceneprior.core.boxes import BOX_EDGES, box_corners
from sceneprior.core.shards import Shard, list_shards

K = np.array([[100.0, 0, 60], [0, 100, 45], [0, 0, 1]])


def test_lines_join_projected_points_and_are_cut_where_they_become_visible(numbers):
    camera = camera_pose(np.array([0.3, 1.5, -3.0]), 0.2, 0.3)
    points = box_corners(numbers.normal(size=3) * 0.2, np.array([1.0, 0.5, 0.8]))
    pixels = (points @ camera[:3, :3].T + camera[:3, 3]) @ K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    lines = project_edges(Hull(points, np.array(BOX_EDGES)), camera, K)
    np.testing.assert_allclose(lines.reshape(-1, 2, 2), pixels[np.array(BOX_EDGES)], rtol=1e-9)
    line = np.array([[0.0, 0.1, -2.0], [0.0, 0.1, 2.0]])
    both_ways = np.array([[0, 1], [1, 0]])
    (there, back) = project_edges(Hull(line, both_ways), np.eye(4), K).tolist()
    assert there == pytest.approx([60, 45 + 100 * 0.1 / NEAR_M, 60, 50])
    assert back == there[2:] + there[:2]
    assert np.isnan(project_edges(Hull(-np.abs(line), both_ways), np.eye(4), K)).all()


@pytest.fixture
def shard(made_once):
    with Shard(list_shards(made_once("bedroom", bedroom_shards), "train")[0]) as opened:
        yield opened


def test_a_view_has_class_colours_and_black_wires_on_the_projected_edges(shard):
    (room_id,) = shard.room_ids
    room, truth = shard.read_room(room_id), shard.read_ground_truth(room_id)
    view = int(room.visible.sum(axis=1).argmax())
    small = np.asarray(draw_view(shard, room_id, view, width_px=120))
    ids = shard.read_instance_ids(room_id, [view])[0]
    plain = (small == BACKGROUND).all(axis=2)
    assert plain[ids == 0].mean() > 0.5 and plain[ids > 0].mean() < 0.05
    with_wires, without = (
        np.asarray(draw_view(shard, room_id, view, boxes_3d=wires)).astype(int)
        for wires in (True, False)
    )
    assert with_wires.shape == (360, 480, 3)
    different = (with_wires != without).any(axis=2)
    lens = np.diag([4.0, 4, 1]) @ room.intrinsics[view]
    on = []
    for k in np.flatnonzero(room.visible[view]):
        box = Hull(box_corners(truth.centers_m[k], truth.sizes_m[k]), np.array(BOX_EDGES))
        for line in project_edges(box, room.world_to_camera[view], lens):
            for share in np.linspace(0.1, 0.9, 30):
                u, v = (line[:2] + share * (line[2:] - line[:2])).astype(int)
                if 2 < u < 477 and 2 < v < 357:
                    on.append(different[v - 1 : v + 2, u - 1 : u + 2].any())
    assert len(on) > 100 and np.mean(on) > 0.8  # frames and names cover the rest
    assert 0 < different.mean() < 0.2


def test_the_plan_shows_every_piece_from_above(shard):
    (room_id,) = shard.room_ids
    truth = shard.read_ground_truth(room_id)
    plan = np.asarray(draw_plan(shard, room_id)).astype(int)
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
