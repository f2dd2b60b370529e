"""Plans that are drawn: each change is a request's text, which the parsers of requests read."""

import math

import numpy as np
import pytest

from sceneprior.apps.viewer.plan import Plan, plan_of
from sceneprior.core.errors import InputError
from sceneprior.lifted.requests.openings import place_openings, read_openings
from sceneprior.lifted.requests.shape import read_floor

L_SHAPE = "0,0 5,0 5,3 2,3 2,5 0,5"
EACH_WALL = "door@0:2, door@1:1, window@2:2, door@3:1.5"


def placed_m(plan: Plan) -> np.ndarray:
    """Ends of the openings as a request with the plan's texts places them, in the plan's order."""
    outline_m = read_floor(plan.floor_text())
    found = place_openings(outline_m, read_openings(plan.openings_text()), np.random.default_rng(0))
    return np.array([[each.start_m, each.end_m] for each in found])


@pytest.mark.parametrize("floor", ["4x3", "4.1x3.25", L_SHAPE, "0,0 6,1 3,5"])
def test_texts_are_read_as_they_were_written(floor):
    plan = plan_of(floor, "door@0:1.5, window, door@north")
    assert plan.floor_text() == floor
    assert plan.openings_text() == "door@0:1.5, window, door@north"
    assert plan_of("", "").floor_text() == "4x3"
    with pytest.raises(InputError, match="expected its size in metres"):
        plan_of("wide", "")
    with pytest.raises(InputError, match=r"7 m along a wall of 4\.00 m"):
        plan_of("4x3", "door@north:7")


def test_named_walls_become_numbers_at_the_same_place():
    """The longest wall that faces south is meant."""
    plan = plan_of(L_SHAPE, "door@west:1, window@south:0.8, door@north:3")
    for opening, middle in zip(plan.openings, [(0, 1), (2.8, 3), (3, 0)], strict=True):
        np.testing.assert_allclose(plan.ends_m(opening).mean(axis=0), middle, atol=1e-9)
    np.testing.assert_allclose(placed_m(plan), [plan.ends_m(each) for each in plan.openings])


def test_a_corner_moves_in_steps_and_never_through_the_outline():
    plan = plan_of("4x3", "")
    moved = plan.with_moved(2, (2.93, 2.04))
    assert moved.floor_text() == "-2,-1.5 2,-1.5 2.9,2 -2,1.5"
    assert plan.with_moved(2, (-2.5, 0.0)) is plan  # would cross the western wall
    assert plan.with_moved(1, (-1.7, 1.5)) is plan  # would leave less than a square metre


@pytest.mark.parametrize("side", range(4))
def test_a_new_corner_on_a_wall_moves_no_door(side):
    plan = plan_of("4x3", EACH_WALL)
    start, end = plan.corners[side], plan.corners[(side + 1) % 4]
    # On the wall and on the grid, 0.5 m from its start.
    x, z = (a + 0.5 * (b - a) / math.dist(start, end) for a, b in zip(start, end, strict=True))
    grown = plan.with_corner(side, (x, z))
    assert len(grown.corners) == 5
    np.testing.assert_allclose(placed_m(grown), placed_m(plan), atol=1e-9)
    back = grown.without_corner(side + 1)
    assert (back.floor_text(), back.openings) == ("4x3", plan.openings)


@pytest.mark.parametrize("corner", range(5))
def test_doors_stay_on_their_walls_when_a_corner_goes(corner):
    plan = plan_of(
        "-2,-1.5 2,-1.5 2,1.5 0,3.5 -2,1.5", "door@0:2, door@1:1, window@2:1.2, door@4:1.5"
    )
    left = plan.without_corner(corner)
    assert len(left.corners) == 4 and len(left.openings) == 4
    walls = [(corner - 1) % 5, corner]
    kept = [
        (before, after)
        for before, after in zip(plan.openings, left.openings, strict=True)
        if before.side not in walls
    ]
    assert len(kept) >= 2
    for before, after in kept:
        np.testing.assert_allclose(left.ends_m(after), plan.ends_m(before), atol=1e-9)
    three = left.without_corner(0)
    assert len(three.corners) == 3 and three.without_corner(1) is three


def test_a_click_near_a_wall_puts_a_door_there():
    plan = plan_of("4x3", "").with_opening("door", (0.52, -1.2)).with_opening("window", (2.3, 1.4))
    assert plan.openings_text() == "door@0:2.5, window@1:2.4"  # the window moved off the corner
    moved = plan.with_opening_moved(0, (-1.7, 0.3))
    assert moved.openings_text() == "door@3:1.2, window@1:2.4"
    assert moved.without_opening(0).openings_text() == "window@1:2.4"
    assert placed_m(moved).shape == (2, 2, 2)


def test_a_plan_is_centred_as_rooms_are():
    plan = plan_of("0,0 4,0 4,3 0,3", "door@0:1.5")
    assert plan.centred().floor_text() == "4x3"
    assert plan.centred().openings_text() == "door@0:1.5"
