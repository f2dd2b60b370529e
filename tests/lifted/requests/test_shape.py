"""Floors of requests: what is read, what is refused, and rectangles in them."""

import numpy as np
import pytest
import shapely

from sceneprior.core.errors import InputError
from sceneprior.core.outline import walls_of
from sceneprior.lifted.requests.shape import RoomShape, read_floor

L_SHAPE = [[0, 0], [5, 0], [5, 3], [2, 3], [2, 6], [0, 6]]
SLANTED = [[0, 0], [4, 0], [5, 3], [2, 4], [0, 3]]


@pytest.mark.parametrize("text", ["4x3", " 4 x 3 m ", "4m x 3m", "4.0X3", "4×3"])
def test_a_size_is_a_rectangle_round_the_origin(text):
    assert read_floor(text).tolist() == [[-2, -1.5], [2, -1.5], [2, 1.5], [-2, 1.5]]


def test_a_closed_outline_loses_its_last_corner():
    assert len(read_floor([*L_SHAPE, L_SHAPE[0]])) == 6
    for text in ("0,0 5,0 5,3 2,3", " [[0, 0], [5, 0.0],\n[5, 3.], [+2, 3]]", "0 0; 5 0; 5 3; 2 3"):
        assert read_floor(text).tolist() == [[0, 0], [5, 0], [5, 3], [2, 3]]


@pytest.mark.parametrize(
    ("floor", "message"),
    [
        ("wide", "The floor is 'wide'; expected its size in metres, such as 4x3"),
        ("0,0 4,0 4", "The floor is '0,0 4,0 4'; expected"),
        ("0,0 4,0 x,3", "at least 3 corners x,z in order"),
        ("400x300", "reaches 200 m from its centre.*Are these centimetres"),
        ("180x200", "The floor is 180 x 200 m large; expected at most 60 m.*Are these centimetres"),
        ([[0, 0], [4000, 0], [4000, 3000]], "Are these millimetres"),
        ([[0, 0], [1, 0]], "at least 3 corners"),
        ([[0, 0], [1, "x"], [1, 1]], "at least 3 corners"),
        ([[0, 0], [3, 0], [6, 0]], "lie on one line"),
        ([[0, 0], [3, 3], [3, 0], [0, 3]], "intersects itself"),
        ("0.5x0.5", "has 0.25 square metres; expected at least 1"),
        ([[0, 0], [4, np.nan], [4, 3]], "expected finite metres"),
    ],
)
def test_what_is_no_floor_is_a_sentence(floor, message):
    with pytest.raises(InputError, match=message):
        read_floor(floor)


def test_rectangles_of_an_l_are_its_arms():
    found = RoomShape(read_floor(L_SHAPE)).rectangles_m
    assert sorted(found.tolist()) == [[1, 3, 2, 6], [2.5, 1.5, 5, 3]]


@pytest.mark.parametrize("floor", [L_SHAPE, SLANTED, SLANTED[::-1], [[0, 0], [6, 0], [0, 6]]])
def test_rectangles_lie_in_the_floor_and_cover_most_of_it(floor):
    shape = RoomShape(read_floor(floor))
    x, z, width, depth = shape.rectangles_m.T
    boxes = shapely.box(x - width / 2, z - depth / 2, x + width / 2, z + depth / 2)
    assert shape.polygon.buffer(0.005).covers(shapely.union_all(boxes))
    assert shapely.union_all(boxes).area > 0.85 * shape.polygon.area


def test_a_floor_that_takes_too_long_is_refused():
    slanted = RoomShape(read_floor([[0, 0], [55, 10], [45, 55]]))
    with pytest.raises(InputError, match="too many to search; give fewer corners, or a smaller"):
        _ = slanted.rectangles_m


def test_a_floor_without_width_is_refused():
    strip = [[0, 0], [20, 0], [20, 0.2], [0, 0.2]]
    with pytest.raises(InputError, match=r"nowhere 0\.3 m wide"):
        _ = RoomShape(read_floor(strip)).rectangles_m


def test_the_area_sets_the_size_that_contents_are_drawn_by():
    shape = RoomShape(read_floor(L_SHAPE))
    assert shape.extents_m.prod() == pytest.approx(shape.polygon.area) == 21
    assert not shape.is_rectangle and RoomShape(read_floor("4x3")).is_rectangle


@pytest.mark.parametrize("floor", [L_SHAPE, L_SHAPE[::-1], SLANTED])
def test_sides_point_into_the_room(floor):
    outline = read_floor(floor)
    polygon = shapely.Polygon(outline)
    for side in walls_of(outline):
        middle = (side.start_m + side.end_m) / 2
        assert polygon.contains(shapely.Point(middle + 0.01 * side.inward))
