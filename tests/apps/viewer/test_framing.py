"""Cameras see all points, and stand no further away than they must."""

import numpy as np
import pytest

from sceneprior.apps.viewer.framing import (
    CORNER,
    FRONT,
    MARGIN,
    box_points,
    framed,
    room_bounds,
)
from sceneprior.core.cameras import look_at
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.core.shell import shell_of


@pytest.mark.parametrize("forward", [CORNER, FRONT])
@pytest.mark.parametrize("aspect", [0.4, 1.3, 3.0])
def test_all_points_just_fit(forward, aspect, rng):
    points = rng.uniform([-4, 0, -2], [3, 2.6, 5], (40, 3))
    eye, target = framed(points, forward, 0.75, aspect)
    matrix = look_at(eye, target)
    x, y, z = matrix[:3, :3] @ points.T + matrix[:3, 3:]
    assert (z > 0).all()
    slope = np.tan(0.75 / 2)
    filled = max((abs(x) / z).max() / (slope * aspect), (abs(y) / z).max() / slope)
    assert filled == pytest.approx(MARGIN, abs=1e-9)
    np.testing.assert_allclose(np.cross(target - eye, forward), 0, atol=1e-9)


def test_bounds_hold_floor_furniture_and_walls():
    shelf = SceneObject("shelf", (1.0, 1.6, 0.0), (0.5, 3.0, 0.4))
    outline = np.array([[-2.0, -1], [2, -1], [2, 1], [-2, 1]])
    scene = Scene("room", "front3d_bedroom", (shelf,), outline, ceiling_m=3.5)
    shell = shell_of(scene)
    assert room_bounds(scene, shell, False).tolist() == [[-2, 0, -1], [2, 3.1, 1]]
    assert room_bounds(scene, shell, True).tolist() == [[-2, 0, -1], [2, 3.5, 1]]
    corners = box_points(np.array([[0.0, 1, 2], [3, 4, 5]]))
    assert sorted(map(tuple, corners.tolist())) == [
        (x, y, z) for x in (0, 3) for y in (1, 4) for z in (2, 5)
    ]
