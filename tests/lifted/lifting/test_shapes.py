"""Lifted shapes: hulls in the frame of a box."""

import numpy as np
import pytest

from sceneprior.core.shards import iterate_rooms
from sceneprior.lifted.lifting import ShapeGrid
from sceneprior.lifted.lifting.boxes import lift_boxes
from sceneprior.lifted.lifting.hulls import lift_shapes

GRID = ShapeGrid(cells=10, margin=1.25)


@pytest.fixture(scope="module")
def room(toy_shards):
    return next(
        (shard.read_room(room_id, images=True), shard.read_ground_truth(room_id))
        for shard, room_id in iterate_rooms(toy_shards, "train")
    )


def test_shapes_fill_the_true_boxes_of_toy_furniture_and_nothing_beyond_the_lifted(room):
    """Toy furniture fills its boxes, so a cell in both of them is the object's own."""
    views, truth = room
    boxes = lift_boxes(views)
    grids = lift_shapes(views, boxes, GRID)
    assert grids.shape == (len(views.object_class), 10, 10, 10)
    steps = (np.arange(10) + 0.5) / 10 - 0.5
    offsets = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1) * GRID.margin
    in_lifted = (np.abs(offsets) < 0.5).all(axis=-1)
    known = np.flatnonzero(boxes.explained > 0)
    assert len(known) > 2
    for item in known:
        grid = grids[item]
        places = boxes.centers_m[item] + offsets * boxes.sizes_m[item]
        reach = truth.sizes_m[item] / 2 - boxes.sizes_m[item] / 10  # a cell inside
        in_true = (np.abs(places - truth.centers_m[item]) < reach).all(axis=-1)
        assert not grid[~in_lifted].any()
        assert grid[in_lifted & in_true].mean() > 0.97
