"""Walls and doors found where masks of floor and walls meet."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from rooms_of_walls import DOOR, HEIGHT_M, L_SHAPE, shell_room

from sceneprior.core.classes import STUFF
from sceneprior.core.observations import stuff_step, thinned_intrinsics
from sceneprior.core.wall_lines import find_ceiling, find_walls, seen_floor

EYES = [(-1.0, 0.5), (-1.2, -0.8), (0.9, -0.7)]
TURNED = [(1.2 * x - 0.5 * z, 0.5 * x + 1.2 * z) for x, z in L_SHAPE]


def distance(points, outline):
    """Largest distance of points from an outline."""
    return shapely.distance(shapely.LinearRing(outline), shapely.points(points)).max()


def ends_of(lines):
    return np.concatenate([[line.start_m, line.end_m] for line in lines])


@pytest.mark.parametrize("roll", range(4))
def test_every_wall_of_an_l_shape_is_found_however_the_camera_is_rolled(roll):
    walls, doors = find_walls(shell_room(L_SHAPE, EYES, roll=roll))
    assert distance(ends_of(walls), L_SHAPE) < 0.03
    found = shapely.union_all([shapely.LineString([w.start_m, w.end_m]) for w in walls])
    outline = shapely.LinearRing(L_SHAPE)
    assert outline.intersection(found.buffer(0.03)).length > 0.95 * outline.length
    floor = shapely.Polygon(L_SHAPE)
    for wall in walls:
        inside = (wall.start_m + wall.end_m) / 2 + 0.1 * wall.inward
        assert floor.contains(shapely.Point(inside)) and wall.error_m < 0.01
    (door,) = doors
    np.testing.assert_allclose(sorted(ends_of([door]).tolist()), sorted(DOOR), atol=0.06)


@pytest.mark.parametrize("roll", range(4))
def test_the_ceiling_is_as_high_as_where_it_meets_walls_whose_tops_are_above_their_bases(roll):
    room = shell_room(L_SHAPE, EYES, roll=roll, size=(240, 180))
    height_m = find_ceiling(room, find_walls(room)[0], range(len(room.visible)))
    assert height_m == pytest.approx(HEIGHT_M, abs=0.01)
    tops, doors = find_walls(room, ceiling_m=height_m)
    assert len(tops) >= 4 and distance(ends_of(tops), L_SHAPE) < 0.03 and not doors
    assert all(shapely.Polygon(L_SHAPE).contains(shapely.Point(
        (top.start_m + top.end_m) / 2 + 0.1 * top.inward)) for top in tops)  # fmt: skip
    assert find_ceiling(room, (), [0]) is None and find_ceiling(room, tops, []) is None


def test_walls_may_have_any_direction():
    eyes = [(1.2 * x - 0.5 * z, 0.5 * x + 1.2 * z) for x, z in EYES]
    walls, _ = find_walls(shell_room(TURNED, eyes))
    assert len(walls) >= 6 and distance(ends_of(walls), TURNED) < 0.07


def test_the_seen_floor_is_where_some_view_shows_floor():
    """Cell by cell, from its definition."""
    room = shell_room(L_SHAPE, EYES[:1], block=(-0.6, 0.2, 0.3, 1.5))
    found = seen_floor(room)
    rng = np.random.default_rng(0)
    K = thinned_intrinsics(room.intrinsics[0], stuff_step(room.image_size))
    wrong = 0
    for x, z in rng.uniform((-2.5, -2), (2.5, 2), (300, 2)):
        shown = False
        for stuff, pose in zip(room.stuff, room.world_to_camera.astype(float), strict=True):
            u, v, depth = K @ (pose @ [x, 0, z, 1])[:3]
            row, column = int(v // max(depth, 1e-9)), int(u // max(depth, 1e-9))
            there = 0 <= row < stuff.shape[0] and 0 <= column < stuff.shape[1] and depth > 0
            shown |= bool(there and stuff[row, column] == STUFF.index("floor"))
        wrong += shown != found.contains(shapely.Point(x, z))
    assert wrong < 15  # at the rim of the floor, by the size of pixels and cells
    blank = replace(room, stuff=np.where(room.stuff == STUFF.index("floor"), 0, room.stuff))
    assert seen_floor(blank).is_empty and find_walls(blank) == ((), ())
