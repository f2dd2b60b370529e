"""Ground truth against masks: right rooms agree, each kind of wrong one does not."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from front_jobs import bedroom_shards, rooms_of

from data_prep.front.views import camera_pose
from data_prep.inspection.agreement import (
    MARGIN,
    NEAR_M,
    Hull,
    Limits,
    Room,
    boxes_around,
    compare,
    failing,
    hull_of,
    hull_of_model,
    true_bodies,
)
from sceneprior.core.errors import ShardError

LARGER = ("views.image_size=[180, 240]", "views.per_m2=2")
K = np.array([[100.0, 0, 60], [0, 100, 45], [0, 0, 1]])


@pytest.fixture(scope="module")
def made(made_once):
    """(views, truth, folder of shards) of a bedroom. Tests only read it."""
    folder = made_once("large_bedroom", lambda folder: bedroom_shards(folder, *LARGER))
    (pair,) = rooms_of(folder).values()
    return *pair, folder


def room_of(views, truth, shards):
    bodies, problems = true_bodies(views, truth, shards)
    return Room(views, bodies), problems


def test_a_right_room_agrees_to_the_pixel(made):
    views = made[0]
    room, problems = room_of(*made)
    seen = compare(room)
    assert problems == [] and set(seen.kinds) == {"mesh"} and (seen.judged == views.visible).all()
    assert seen.iou[seen.judged & seen.whole].min() > 0.85
    tally = seen.agreement["mesh"]
    # What is hidden in part lies within its projection, too.
    assert tally.share == 1.0 and tally.masks == views.visible.sum() and tally.mean_iou > 0.95
    assert 3 < seen.whole.sum() < views.visible.sum()
    assert views.sides_clear[seen.whole].all()
    margin = MARGIN * room.size_px[0]
    for grow, share in ((margin - 1.5, 1.0), (margin + 1.5, 0.0)):
        boxes = views.boxes + np.array([-1, -1, 1, 1]) * grow / np.tile(room.size_px, 2)
        wider = compare(room._replace(views=replace(views, boxes=boxes)))
        assert wider.held[seen.whole].mean() == share
    behind = compare(room.seen_by(np.diag([1, -1, -1, 1.0]) @ views.world_to_camera))
    tally = behind.agreement["mesh"]
    assert tally.masks == views.visible.sum() and tally.share == tally.mean_iou == 0.0
    assert failing({"mesh": tally}, Limits()) == [tally]


def test_models_that_are_missing_or_damaged_are_named(made, tmp_path):
    views, truth, _ = made
    shards = shutil.copytree(made[2], tmp_path / "shards")
    path = shards / "models" / f"{truth.model_ids[0]}.ply"
    path.write_bytes(path.read_bytes()[:-20])
    hull_of_model.cache_clear()
    with pytest.raises(ShardError, match=r"\.ply is not a triangle mesh \("):
        hull_of_model(path)
    path.unlink()
    room, problems = room_of(views, truth, shards)
    assert None in room.bodies and not compare(room).judged[:, room.bodies.index(None)].any()
    assert ".ply is missing, but a room's ground truth refers to it" in problems[0]


def test_a_mirrored_truth_does_not_agree(made):
    views, truth, shards = made
    mirror = np.diag([-1.0, 1, 1, 1])
    moved = replace(truth, model_to_room=(mirror @ truth.model_to_room).astype(np.float32))
    room, problems = room_of(views, moved, shards)
    tally = compare(room).agreement["mesh"]
    assert tally.mean_iou < 0.6 and failing({"mesh": tally}, Limits()) == [tally]
    assert len(problems) >= 2 and "m from the box around its placed mesh" in problems[0]


def test_a_hull_projects_as_all_of_its_points_do(numbers):
    points = numbers.normal(size=(500, 3)) * (1.0, 0.5, 0.1)
    hull = hull_of(points)
    assert len(hull.points_m) < 150
    near = camera_pose(np.array([0.0, 0.1, -0.6]), 0.0, 0.1)  # some points lie behind it
    for camera in (camera_pose(np.array([0.3, 1.5, -3.0]), 0.2, 0.3), near):
        here = points @ camera[:3, :3].T + camera[:3, 3]
        # All lines between points, cut at the near plane: slow, and the same.
        a, b = (here[rows] for rows in np.triu_indices(len(here), 1))
        cross = (a[:, 2] < NEAR_M) != (b[:, 2] < NEAR_M)
        a, b = a[cross], b[cross]
        cut = a + (b - a) * ((NEAR_M - a[:, 2:]) / (b[:, 2:] - a[:, 2:]))
        seen = np.concatenate([here[here[:, 2] >= NEAR_M], cut]) @ K.T
        pixels = seen[:, :2] / seen[:, 2:]
        (box,) = boxes_around(hull, camera[None], K[None])
        np.testing.assert_allclose(box, [*pixels.min(axis=0), *pixels.max(axis=0)], rtol=1e-6)
    behind = Hull(-np.abs(points), hull_of(points).edges)
    assert np.isnan(boxes_around(behind, np.eye(4)[None], K[None])).all()


@pytest.mark.parametrize("flat", [(1, 0, 1), (0, 0, 1), (0, 0, 0)])
def test_flat_things_have_a_hull(flat, numbers):
    points = numbers.normal(size=(30, 3)) * flat
    hull = hull_of(points)
    np.testing.assert_allclose(hull.points_m.min(axis=0), points.min(axis=0), atol=1e-9)
    np.testing.assert_allclose(hull.points_m.max(axis=0), points.max(axis=0), atol=1e-9)
