"""Boxes and rays from masks: near to the truth, exact on paper, defined where nothing is known."""

from dataclasses import replace

import numpy as np
import pytest

from sceneprior.core.shards import iterate_rooms
from sceneprior.lifted.lifting.boxes import RAYS, draw_rays, lift_boxes, own_rays, smallest_box
from sceneprior.lifted.lifting.hulls import pass_through, sightings_of


@pytest.fixture(scope="module")
def rooms(toy_shards):
    return [
        (shard.read_room(room, images=True), shard.read_ground_truth(room))
        for shard, room in iterate_rooms(toy_shards, "train")
    ]


def iou(centers_a, sizes_a, centers_b, sizes_b):
    low = np.maximum(centers_a - sizes_a / 2, centers_b - sizes_b / 2)
    high = np.minimum(centers_a + sizes_a / 2, centers_b + sizes_b / 2)
    both = (high - low).clip(0).prod(axis=-1)
    return both / (sizes_a.prod(axis=-1) + sizes_b.prod(axis=-1) - both)


def test_boxes_are_those_of_the_room(rooms):
    """Eight views of 96 x 72 pixels, a quarter of them behind something: 0.70 was measured; a cube
    of the mean size at the right place has 0.25."""
    found = []
    for views, truth in rooms:
        boxes, count = lift_boxes(views), len(views.object_class)
        found.append(iou(*boxes[:2], truth.centers_m[:count], truth.sizes_m[:count]))
        known = boxes.explained > 0
        assert known.tolist() == (views.visible.sum(axis=0) > 1).tolist()
        assert (boxes.explained[known] > 0.85).all()
        found[-1] = found[-1][known]
    assert np.concatenate(found).mean() > 0.6


def test_room_and_cameras_move_together(rooms):
    """By a sum of powers of two, which float32 poses take without rounding much."""
    views = rooms[1][0]
    shift = np.array([4.0, 0.0, -2.0], np.float32)
    poses = views.world_to_camera.copy()
    poses[:, :3, 3] -= poses[:, :3, :3] @ shift
    moved = lift_boxes(replace(views, world_to_camera=poses))
    still = lift_boxes(views)
    # A pixel on the border of a cell may fall to its other side: a cell is some 4 cm.
    np.testing.assert_allclose(moved.centers_m - shift, still.centers_m, rtol=0, atol=0.06)
    np.testing.assert_allclose(moved.sizes_m, still.sizes_m, rtol=0, atol=0.12)


def test_what_few_views_show_has_a_defined_box(rooms):
    views, _ = rooms[0]
    nowhere = views.visible.copy()
    nowhere[:, 0] = False
    boxes = lift_boxes(replace(views, visible=nowhere))
    assert boxes.explained[0] == 0 and boxes.explained[1] > 0
    once = nowhere.copy()
    once[np.flatnonzero(views.visible[:, 0])[0], 0] = True
    boxes = lift_boxes(replace(views, visible=once))
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


def test_rays_go_through_the_objects_own_pixels(rooms):
    """Through their centres; among them, in every view, an outermost one at each clear side."""
    views = rooms[0][0]
    item = int(views.visible.sum(axis=0).argmax())
    rows = np.flatnonzero(views.visible[:, item])
    seen = sightings_of(views, rows, item)
    checked = 0
    for row, (view, clear) in enumerate(zip(rows, views.sides_clear[rows, item], strict=True)):
        one = seen._replace(ids=seen.ids[row : row + 1], boxes_px=seen.boxes_px[row : row + 1])
        pose, camera = views.world_to_camera[view].astype(float), views.intrinsics[view]
        origins, directions = own_rays(
            one, pose[None], camera[None], clear[None], np.random.default_rng(0)
        )
        np.testing.assert_allclose(origins @ pose[:3, :3].T + pose[:3, 3], 0, atol=1e-5)
        x, y, depth = camera @ pose[:3, :3] @ directions.T
        place = np.stack([x / depth, y / depth])
        # Float32 poses: a ten-thousandth of a pixel or so.
        np.testing.assert_allclose(place % 1, 0.5, rtol=0, atol=1e-2)
        u, v = np.floor(place).astype(int)
        mask = seen.ids[row] == item + 1
        assert mask[v, u].all() and len(u) == RAYS + clear.sum()
        own_v, own_u = np.nonzero(mask)
        ends = [own_u.min(), own_v.min(), own_u.max(), own_v.max()]
        met = [u.min(), v.min(), u.max(), v.max()]
        assert [end == there for end, there, is_clear in zip(ends, met, clear, strict=True)
                if is_clear] == [True] * int(clear.sum())  # fmt: skip
        checked += int(clear.sum())
    assert checked > 4


MARGIN = 1.2


def test_a_hit_meets_the_true_box_and_a_span_without_one_is_empty(rooms):
    """Toy furniture fills its boxes. A ray is cast from a pixel's centre, and so was the id."""
    views, truth = rooms[0]
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


def test_passing_a_box_from_outside_inside_beside_and_along_a_side():
    low, high = np.zeros(3), np.ones(3)
    origins = np.array([[-1, 0.5, 0.5], [0.5, 0.5, 0.5], [-1, 2, 0.5], [-1, 0, 0.5], [2, 0.5, 0.5]])
    near, far = pass_through(origins, np.tile([1.0, 0, 0], (5, 1)), low, high)
    assert near[:2].tolist() == [1, 0] and far[:2].tolist() == [2, 0.5]
    assert far[2] <= near[2] and (near[3], far[3]) == (1, 2) and far[4] <= near[4]
