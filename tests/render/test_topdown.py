"""Scale, position and colours of top-down pictures."""

import numpy as np
import pytest

from sceneprior.core.classes import class_colors
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.render.topdown import perspective, topdown

BED, LAMP = 9, 14  # rows of double_bed and pendant_lamp in the bedroom label set


def bedroom(*objects: SceneObject) -> Scene:
    return Scene("room", "front3d_bedroom", objects)


def test_a_cube_covers_exactly_its_pixels_with_x_right_and_z_down():
    # 12.5 mm a pixel: 1 m is 80 pixels, and the origin is the corner shared by pixels 255, 256.
    cube = SceneObject("double_bed", (1.0, 0.5, 2.0), (1.0, 1.0, 1.0))
    image = topdown(bedroom(cube))
    expected = np.full((512, 512, 3), 255, np.uint8)
    expected[256 + 120 : 256 + 200, 256 + 40 : 256 + 120] = class_colors(22)[BED]
    np.testing.assert_array_equal(image, expected)


def test_the_whole_room_fits_into_the_perspective():
    scene = bedroom(
        SceneObject("wardrobe", (-1.5, 1.0, -1.0), (1.0, 2.0, 0.6)),
        SceneObject("pendant_lamp", (1.0, 2.4, 1.0), (0.5, 0.5, 0.5)),
    )
    image = perspective(scene, (120, 160))
    rows, columns = np.nonzero((image != 255).any(-1))
    # 4% of air, half of it on each side, in the direction that is the tighter one.
    fill = (np.ptp(rows) + 1) / 120, (np.ptp(columns) + 1) / 160
    assert max(fill) == pytest.approx(0.96, abs=0.02)
    assert rows.min() + rows.max() == pytest.approx(119, abs=2)
    assert columns.min() + columns.max() == pytest.approx(159, abs=2)
