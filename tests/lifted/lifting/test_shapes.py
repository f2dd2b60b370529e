"""Lifted shapes: hulls in the frame of a box."""

from dataclasses import replace

import numpy as np
import pytest

from sceneprior.core.shards import iterate_rooms
from sceneprior.lifted.lifting import ShapeGrid
from sceneprior.lifted.lifting.boxes import lift_boxes
from sceneprior.lifted.lifting.hulls import EMPTY, REACH, carve, lift_shapes, sightings_of

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


def test_a_shape_is_the_hull_where_few_views_see_past(room):
    views, _ = room
    boxes = lift_boxes(views)
    grids = lift_shapes(views, boxes, GRID)
    item = 0
    rows = np.flatnonzero(views.visible[:, item])
    seen = sightings_of(views, rows, item)
    half = GRID.margin * boxes.sizes_m[item] / 2
    hull = carve(seen, boxes.centers_m[item] - half, boxes.centers_m[item] + half, 10, REACH)
    # 10 cells span 1.25 boxes: the outermost on each side lies beyond the box.
    wanted = np.pad(hull.emptiness[1:-1, 1:-1, 1:-1] <= EMPTY, 1)
    np.testing.assert_array_equal(grids[item], wanted)


def test_an_object_without_a_box_has_no_shape_and_fewer_views_are_asked(room):
    views, _ = room
    visible = views.visible.copy()
    visible[:, 0] = False
    unseen = replace(views, visible=visible)
    found = lift_boxes(unseen)
    filled = lift_shapes(unseen, found, GRID).any(axis=(1, 2, 3))
    np.testing.assert_array_equal(filled, found.explained > 0)
    assert not filled[0] and filled[1:].any()
    boxes = lift_boxes(views)
    half = lift_shapes(views, boxes, GRID, np.arange(0, len(views.visible), 2))
    assert (half != lift_shapes(views, boxes, GRID)).any()
