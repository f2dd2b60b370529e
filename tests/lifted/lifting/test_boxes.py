"""Hulls, boxes and rays from masks: near to the truth, and what is compiled against slow twins."""

from dataclasses import replace

import numpy as np
import pytest

from sceneprior.core.boxes import box_iou_3d
from sceneprior.core.shards import iterate_rooms
from sceneprior.lifted.lifting import ShapeGrid
from sceneprior.lifted.lifting.boxes import (
    draw_rays,
    lift_boxes,
    pass_through,
    smallest_box,
)
from sceneprior.lifted.lifting.hidden_sides import planes_of
from sceneprior.lifted.lifting.hulls import MOST_EMPTY, NEVER, Sightings, carve, lift_shapes

MARGIN = 1.2
FLOOR = planes_of([], None)


@pytest.fixture(scope="module")
def rooms(toy_shards):
    return [
        (shard.read_room(room, images=True), shard.read_ground_truth(room))
        for shard, room in iterate_rooms(toy_shards, "train")
    ]


def emptiness_cell_by_cell(seen: Sightings, low, high, cells: int, reach: float):
    """The definition of `carve`, in float64."""
    height, width = seen.ids.shape[1:]
    size = (high - low) / cells
    found = np.empty((cells,) * 3)
    for cell in np.ndindex(*found.shape):
        point = low + (np.array(cell) + 0.5) * size
        own = past = 0
        for pose, lens, ids in zip(
            seen.world_to_camera.astype(float), seen.intrinsics.astype(float), seen.ids, strict=True
        ):
            x, y, depth = lens @ (pose[:3, :3] @ point + pose[:3, 3])
            if depth < 0.1:
                continue
            u, v = int(np.floor(x / depth)), int(np.floor(y / depth))
            if not (0 <= u < width and 0 <= v < height):
                continue
            around = int(reach * size.max() * lens[0, 0] / depth + 0.5)
            window = ids[max(v - around, 0) : v + around + 1, max(u - around, 0) : u + around + 1]
            if (window == seen.own_id).any():
                own += 1
            elif ids[v, u] == 0:
                past += 1
        too_empty = past > MOST_EMPTY * len(seen.ids) + 0.5
        share = max(past - 0.5, 0) / max(own + past, 1)
        found[cell] = NEVER if own < 2 or too_empty else share
    return found


@pytest.mark.parametrize(("item", "reach"), [(0, 0.0), (1, 0.5)])
def test_carving_is_the_definition(rooms, item, reach):
    seen = Sightings.of(rooms[0][0], item)
    low, high = np.array([-2.3, -0.1, -2.0]), np.array([2.1, 2.4, 1.9])
    hull = carve(seen, low, high, 9, reach)
    by_hand = emptiness_cell_by_cell(seen, low, high, 9, reach)
    np.testing.assert_allclose(hull.emptiness, by_hand, rtol=0, atol=1e-6)  # float32 shares
    assert 0 < (hull.emptiness < NEVER).sum() < hull.emptiness.size


def test_passing_a_box_from_outside_inside_beside_and_along_a_side():
    low, high = np.zeros(3), np.ones(3)
    origins = np.array([[-1, 0.5, 0.5], [0.5, 0.5, 0.5], [-1, 2, 0.5], [-1, 0, 0.5], [2, 0.5, 0.5]])
    near, far = pass_through(origins, np.tile([1.0, 0, 0], (5, 1)), low, high)
    assert near[:2].tolist() == [1, 0] and far[:2].tolist() == [2, 0.5]
    assert far[2] <= near[2] and (near[3], far[3]) == (1, 2) and far[4] <= near[4]


def test_boxes_are_those_of_the_room(rooms):
    """Eight views of 96 x 72 pixels, a quarter of them behind something: 0.70 was measured; a cube
    of the mean size at the right place has 0.25."""
    found = []
    for views, truth in rooms:
        boxes, count = lift_boxes(views, FLOOR), len(views.object_class)
        true = truth.centers_m[:count].astype(float), truth.sizes_m[:count].astype(float)
        known = boxes.explained > 0
        assert known.tolist() == (views.visible.sum(axis=0) > 1).tolist()
        assert (boxes.explained[known] > 0.85).all()
        found.append(np.diag(box_iou_3d(*boxes[:2], *true))[known])
    assert np.concatenate(found).mean() > 0.6


def test_what_few_views_show_has_a_defined_box(rooms):
    views, _ = rooms[0]
    nowhere = views.visible.copy()
    nowhere[:, 0] = False
    boxes = lift_boxes(replace(views, visible=nowhere), FLOOR)
    assert boxes.explained[0] == 0 and boxes.explained[1] > 0
    once = nowhere.copy()
    once[np.flatnonzero(views.visible[:, 0])[0], 0] = True
    boxes = lift_boxes(replace(views, visible=once), FLOOR)
    assert boxes.explained[0] == 0, "one view does not tell how far away it is"
    assert np.isfinite(boxes.centers_m).all() and (boxes.sizes_m > 0).all()


def smallest_box_step_by_step(where, in_hull, cells):
    """Move one side by one cell, as long as every ray that met the hull meets it inside."""
    first, last = np.zeros(3, int), np.full(3, cells)
    met = in_hull.any(axis=1)

    def holds():
        inside = in_hull[met] & (where[met] >= first).all(-1) & (where[met] < last).all(-1)
        return inside.any(axis=1).all()

    for axis in range(3):
        for side, step in ((first, 1), (last, -1)):
            while met.any() and first[axis] < last[axis]:
                side[axis] += step
                if not holds():
                    side[axis] -= step
                    break
    return first, last


@pytest.mark.parametrize("seed", range(20))
def test_the_smallest_box_is_that_of_single_steps(seed):
    rng = np.random.default_rng(seed)
    where = rng.integers(0, 7, (9, 5, 3))
    in_hull = rng.random((9, 5)) < 0.6
    found = smallest_box(where, in_hull, 7)
    for one, other in zip(found, smallest_box_step_by_step(where, in_hull, 7), strict=True):
        assert one.tolist() == other.tolist()


def test_void_furniture_is_unknown_and_changes_no_box_and_no_hull_of_others(rooms):
    """The last object's id becomes that of void. Fewer rays tell something of the others' shapes:
    its box is not known."""
    views, truth = rooms[0]
    void = replace(
        views, object_class=views.object_class[:-1],
        **{name: getattr(views, name)[:, :-1] for name in
           ("boxes", "visible", "sides_clear", "mask_pixels")},
    )  # fmt: skip
    boxes = lift_boxes(void, FLOOR)
    for here, there in zip(boxes, lift_boxes(views, FLOOR), strict=True):
        np.testing.assert_array_equal(here, there[:-1])
    grid = ShapeGrid(cells=12, margin=MARGIN)
    np.testing.assert_array_equal(
        lift_shapes(void, boxes, grid), lift_shapes(views, lift_boxes(views, FLOOR), grid)[:-1]
    )
    pool = draw_rays(void, boxes, 300, MARGIN)
    for item in np.flatnonzero(boxes.explained > 0):
        # Toy furniture fills its boxes. A ray is cast from a pixel's centre, and so was the id.
        scale = MARGIN * boxes.sizes_m[item] / 2
        spans = pool.spans[item] * scale
        length = np.linalg.norm(spans, axis=1)
        known = length > 0
        center_m, half_m = truth.centers_m[item].astype(float), truth.sizes_m[item] / 2.0
        starts = (pool.starts[item] * scale + boxes.centers_m[item])[known]
        ways = spans[known] / length[known, None]
        near, far = pass_through(starts, ways, center_m - half_m, center_m + half_m)
        met = (far > near) & (near <= length[known] + 1e-3)
        hits = pool.hits[item][known]
        assert 0.1 < hits.mean() < 0.9, "rays teach both ways"
        assert met[hits].mean() > 0.97 and (~met[~hits]).mean() > 0.97
