"""The floor that views show, and the floor between walls."""

from dataclasses import replace

import numpy as np
import shapely
from rooms_of_walls import L_SHAPE, shell_room

from sceneprior.core.classes import STUFF
from sceneprior.core.found_floor import CELL_M, find_floor
from sceneprior.core.shards import stuff_step, thinned_intrinsics

EYES = [(-1.0, 0.5), (-1.2, -0.8), (0.9, -0.7)]
TRUE = shapely.Polygon(L_SHAPE)


def iou(one, other):
    return one.intersection(other).area / one.union(other).area


def test_an_empty_room_is_seen_whole():
    found = find_floor(shell_room(L_SHAPE, EYES))
    assert iou(found.seen, TRUE) > 0.95 and iou(found.floor, TRUE) > 0.98
    assert found.seen.difference(TRUE.buffer(CELL_M)).is_empty
    assert len(found.walls) >= 6 and len(found.doors) == 1


def test_furniture_hides_floor_which_lies_between_the_walls():
    room = shell_room(L_SHAPE, EYES, block=(-0.6, 0.2, 0.3, 1.5))
    found = find_floor(room)
    hidden = shapely.box(-0.55, 0.25, 0.25, 1.5)
    assert found.seen.intersection(hidden).area < 0.01
    assert iou(found.seen, TRUE) < 0.9 and iou(found.floor, TRUE) > 0.97


def test_the_seen_floor_is_where_some_view_shows_floor():
    """Cell by cell, from its definition."""
    room = shell_room(L_SHAPE, EYES[:1], block=(-0.6, 0.2, 0.3, 1.5))
    found = find_floor(room)
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
        wrong += shown != found.seen.contains(shapely.Point(x, z))
    assert wrong < 15  # at the rim of the floor, by the size of pixels and cells


def test_a_room_without_floor_has_none():
    room = shell_room(L_SHAPE, EYES)
    blank = np.where(room.stuff == STUFF.index("floor"), 0, room.stuff)
    found = find_floor(replace(room, stuff=blank))
    assert found.seen.is_empty and found.floor.is_empty and found.walls == found.doors == ()
