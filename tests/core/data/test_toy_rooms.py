"""The toy rooms themselves: what other tests stand on has to be consistent."""

import numpy as np
import torch
from toy_rooms import HALF_M, make_toy_room

from sceneprior.core.geometry.cameras import boxes_of_points
from sceneprior.core.geometry.corners import box_corners
from sceneprior.core.shards import Shard, list_shards


def test_the_same_seed_gives_the_same_room():
    one, truth = make_toy_room("a", np.random.default_rng(5))
    again, _ = make_toy_room("a", np.random.default_rng(5))
    np.testing.assert_array_equal(one.instance_ids, again.instance_ids)
    np.testing.assert_array_equal(one.boxes, again.boxes)
    assert (np.abs(truth.centers_m[:, [0, 2]]) < HALF_M).all()


def test_twelve_rooms_and_four_in_which_most_things_are_seen(toy_shards):
    counts = {"train": 0, "test": 0}
    seen = []
    for split in counts:
        for path in list_shards(toy_shards, split):
            with Shard(path) as shard:
                for room_id in shard.room_ids:
                    counts[split] += 1
                    room = shard.read_room(room_id)
                    assert 3 <= len(room.object_class) <= 5
                    seen.append(room.visible.mean())
    assert counts == {"train": 12, "test": 4}
    assert np.mean(seen) > 0.5


def test_projecting_the_true_boxes_gives_the_measured_ones(toy_shards):
    """Only unhidden objects: their masks end within a pixel and a half of the projection."""
    compared = 0
    with Shard(list_shards(toy_shards, "train")[0]) as shard:
        for room_id in shard.room_ids:
            room, truth = shard.read_room(room_id, images=True), shard.read_ground_truth(room_id)
            count = len(room.object_class)
            corners = box_corners(
                torch.from_numpy(truth.centers_m[:count]), torch.from_numpy(truth.sizes_m[:count])
            )
            projected, inside = boxes_of_points(
                corners[None],
                torch.from_numpy(room.world_to_camera)[None],
                torch.from_numpy(room.intrinsics)[None],
                room.image_size,
            )
            assert inside[0].numpy()[room.visible].all()
            size = np.array([96, 72, 96, 72])
            error = (room.boxes - projected[0].numpy()) * size
            # A measured box never reaches beyond the projected one by more than half a pixel
            # (its last pixel's centre is inside) ...
            outside = error * [-1, -1, 1, 1]
            assert outside[room.visible].max() <= 0.5 + 1e-3
            exact = (np.abs(error).max(axis=-1) <= 1.5) & room.visible
            compared += exact.sum()
            # ... and the lamp hangs free in most views.
            lamp = list(room.object_class).index(4)
            assert exact[:, lamp].mean() >= 0.25
    assert compared >= 60
