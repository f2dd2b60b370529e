"""Floors of requests: what is read, and the rectangles in them."""

import pytest
import shapely

from sceneprior.core.errors import InputError
from sceneprior.lifted.requests.floors import Floor, read_floor

L_SHAPE = [[0, 0], [5, 0], [5, 3], [2, 3], [2, 6], [0, 6]]
SLANTED = [[0, 0], [4, 0], [5, 3], [2, 4], [0, 3]]


@pytest.mark.parametrize("text", ["4x3", " 4 x 3 m ", "4m x 3m", "4.0X3", "4×3"])
def test_a_size_is_a_rectangle_round_the_origin(text):
    assert read_floor(text).tolist() == [[-2, -1.5], [2, -1.5], [2, 1.5], [-2, 1.5]]


def test_a_closed_outline_loses_its_last_corner():
    assert len(read_floor([*L_SHAPE, L_SHAPE[0]])) == 6
    for text in ("0,0 5,0 5,3 2,3", " [[0, 0], [5, 0.0],\n[5, 3.], [+2, 3]]", "0 0; 5 0; 5 3; 2 3"):
        assert read_floor(text).tolist() == [[0, 0], [5, 0], [5, 3], [2, 3]]


def test_rectangles_of_an_l_are_its_arms():
    found = Floor(read_floor(L_SHAPE)).rectangles_m
    assert sorted(found.tolist()) == [[1, 3, 2, 6], [2.5, 1.5, 5, 3]]


@pytest.mark.parametrize("floor", [L_SHAPE, SLANTED, SLANTED[::-1], [[0, 0], [6, 0], [0, 6]]])
def test_rectangles_lie_in_the_floor_and_cover_most_of_it(floor):
    shape = Floor(read_floor(floor))
    x, z, width, depth = shape.rectangles_m.T
    boxes = shapely.box(x - width / 2, z - depth / 2, x + width / 2, z + depth / 2)
    assert shape.polygon.buffer(0.005).covers(shapely.union_all(boxes))
    assert shapely.union_all(boxes).area > 0.85 * shape.polygon.area


def test_a_corner_that_is_listed_twice_is_one_corner():
    twice = [corner for corner in L_SHAPE for _ in range(2)]
    assert read_floor(twice).tolist() == L_SHAPE
    with pytest.raises(InputError):
        read_floor([[0, 0], [0, 0], [4, 0], [4, 0]])
