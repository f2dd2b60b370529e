"""Plans: outlines, walls, and that pieces stand clear of each other inside the room."""

from itertools import combinations

import numpy as np
import pytest
from homes_on_disk import TYPES
from shapely.geometry import Point, Polygon

from data_prep.homes.catalog import make_catalog
from data_prep.homes.layout import Piece, Plan

CEILING_CLASSES = {"pendant_lamp", "ceiling_lamp"}

NOTCHES = [(0, 0, 1, 0.5), (3, 0, 4, 0.5), (3, 2.5, 4, 3), (0, 2.5, 1, 3)]
"""A corner bitten off a room of 4 m x 3 m, each in turn."""


def nightstand(x: float, z: float, yaw_rad: float = 0.0) -> Piece:
    model = make_catalog(0, "front3d_bedroom")["nightstand"][0]
    return Piece(model, (1.0, 1.0, 1.0)).at(x, z, yaw_rad)


@pytest.mark.parametrize("notch", [None, *NOTCHES])
def test_walls_go_around_the_floor_with_the_room_to_their_left(notch):
    plan = Plan(4.0, 3.0, 2.7, notch)
    floor = Polygon(plan.outline)
    assert floor.is_valid and floor.exterior.is_ccw
    assert floor.area == pytest.approx(plan.area) == pytest.approx(11.5 if notch else 12)
    assert sum(wall.length for wall in plan.walls) == pytest.approx(floor.length)
    for wall in plan.walls:
        assert floor.contains(Point(wall.point(wall.length / 2, 0.1)))
        assert floor.exterior.distance(Point(wall.point(wall.length, 0.0))) < 1e-12
        front = (np.sin(wall.yaw_rad), np.cos(wall.yaw_rad))
        np.testing.assert_allclose(
            np.subtract(wall.point(1, 2), wall.point(1, 1)), front, atol=1e-12
        )


def test_a_piece_fits_where_floor_and_air_are_free():
    door = (3.5, 2.5, 4.0, 3.0)
    plan = Plan(4.0, 3.0, 2.7, NOTCHES[0], kept_clear=[door])
    width, height, depth = nightstand(0, 0).size_m
    assert not plan.fits(nightstand(0.5, 0.25))  # in the notch
    assert not plan.fits(nightstand(4 - width / 2, 1.5))  # touches the wall
    assert plan.fits(nightstand(4 - width / 2 - 0.005, 1.5))
    assert plan.add(nightstand(2, 1.5), clearance=0.5)
    assert not plan.fits(nightstand(2 + width / 2, 1.5))
    in_front = nightstand(2, 1.5 + depth + 0.1)
    assert not plan.fits(in_front) and plan.fits(in_front, crowding=True)
    assert plan.fits(in_front.at(2, 1.5, 0, y=height))  # above the other
    assert not plan.fits(in_front.at(2, 1.5, 0, y=2.71 - height))  # through the ceiling
    assert not plan.add(nightstand(2, 0.5, np.pi), clearance=0.5)  # too close to the wall
    assert not plan.fits(nightstand(3.5, 2.5), crowding=True)  # before the door
    assert len(plan.pieces) == 1 and len(plan.kept_clear) == 2


@pytest.mark.parametrize("room_type", TYPES)
def test_no_boxes_intersect_and_all_stand_inside(rooms, room_type):
    for room in rooms[room_type]:
        for a, b in combinations(room["pieces"], 2):
            if min(a["levels"][1], b["levels"][1]) - max(a["levels"][0], b["levels"][0]) > 1e-4:
                assert a["footprint"].intersection(b["footprint"]).area == 0, room["id"]
        inside = room["floor"].buffer(1e-4)  # coordinates are rounded to 1e-5
        for piece in room["pieces"]:
            assert inside.contains(piece["footprint"]), (room["id"], piece["class"])
            assert piece["levels"][1] <= room["height"] + 1e-3
            if piece["class"] in CEILING_CLASSES:
                assert piece["levels"][1] == pytest.approx(room["height"], abs=1e-3)
                assert piece["levels"][0] > 1.0
            else:
                assert piece["levels"][0] == pytest.approx(0, abs=1e-4)
