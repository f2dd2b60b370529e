"""Pictures from above and from a corner: scale, position and colours, pixel by pixel."""

import numpy as np
import pytest

from sceneprior.core.classes import class_colors
from sceneprior.core.scene import Opening, Scene, SceneObject
from sceneprior.render.appearance import FLOOR_COLOR, paint_ids
from sceneprior.render.topdown import (
    DOOR,
    PLAN_PX,
    WALL,
    WINDOW,
    floor_plan,
    html_of,
    perspective,
    topdown,
)


def test_a_cube_covers_exactly_its_pixels_with_x_right_and_z_down():
    # 12.5 mm a pixel: 1 m is 80 pixels, and the origin is the corner shared by pixels 255, 256.
    cube = SceneObject("double_bed", (1.0, 0.5, 2.0), (1.0, 1.0, 1.0))
    image = topdown(Scene("room", "front3d_bedroom", (cube,)))
    expected = np.full((512, 512, 3), 255, np.uint8)
    expected[256 + 120 : 256 + 200, 256 + 40 : 256 + 120] = class_colors(22)[9]
    np.testing.assert_array_equal(image, expected)


def test_the_whole_room_fits_into_the_perspective():
    wardrobe = SceneObject("wardrobe", (-1.5, 1.0, -1.0), (1.0, 2.0, 0.6))
    lamp = SceneObject("pendant_lamp", (1.0, 2.4, 1.0), (0.5, 0.5, 0.5))
    image = perspective(Scene("room", "front3d_bedroom", (wardrobe, lamp)), (120, 160))
    rows, columns = np.nonzero((image != 255).any(-1))
    # 4% of air, half of it on each side, in the direction that is the tighter one.
    fill = (np.ptp(rows) + 1) / 120, (np.ptp(columns) + 1) / 160
    assert max(fill) == pytest.approx(0.96, abs=0.02)
    assert rows.min() + rows.max() == pytest.approx(119, abs=2)
    assert columns.min() + columns.max() == pytest.approx(159, abs=2)


def test_floors_walls_and_openings_are_drawn_to_scale():
    floor_m = np.array([[0, 0], [4, 0], [4, 2], [2, 2], [2, 4], [0, 4]], float)
    door = Opening("door", (4, 0.5), (4, 1.4), 0.0, 2.0)
    window = Opening("window", (0.5, 0), (1.5, 0), 0.9, 2.0)
    picture = floor_plan(Scene("a", "front3d_bedroom", (), floor_m, openings=(door, window)))
    scale = PLAN_PX * 0.9 / 4
    found = {
        color: np.argwhere((picture[:, :PLAN_PX] == color).all(axis=-1))[:, ::-1]
        for color in (FLOOR_COLOR, WALL, DOOR, WINDOW)
    }
    assert len(found[FLOOR_COLOR]) / scale**2 == pytest.approx(12, rel=0.03)
    assert len(found[WALL]) > 1000
    for color, length_m, axis in ((DOOR, 0.9, 1), (WINDOW, 1.0, 0)):
        assert np.ptp(found[color][:, axis]) == pytest.approx(length_m * scale, abs=4)


def test_ids_have_their_colours_and_dark_borders():
    ids = np.array([[0, 0, 1, 1], [0, 0, 1, 1], [2, 2, 2, 2]])
    picture = paint_ids(ids, np.array([[100, 0, 0], [0, 60, 0]]), (9, 9, 9))
    assert picture[0].tolist() == [[9, 9, 9], [9, 9, 9], [50, 0, 0], [100, 0, 0]]
    assert picture[2].tolist() == [[0, 30, 0]] * 4


def test_notebooks_show_class_names_as_they_are():
    bed = SceneObject("<i>bed & co", (0.0, 0.5, 0.0), (1.0, 1.0, 1.0))
    shown = html_of(Scene("a<b", "void,<i>bed & co", (bed,)))
    assert "<figcaption>a&lt;b: &lt;i&gt;bed &amp; co</figcaption>" in shown
