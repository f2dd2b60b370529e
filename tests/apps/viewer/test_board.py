"""Rays onto the map's board, and back."""

import numpy as np
import pytest
import torch

from sceneprior.apps.viewer.board import BoardPlane
from sceneprior.apps.viewer.latent_map import make_map
from sceneprior.paper.latents import LatentCube


@pytest.fixture
def plane(torch_rng):
    cube = LatentCube(5)
    latent_map = make_map(cube, cube(torch.randn(9, 5, generator=torch_rng)))
    return BoardPlane(latent_map, (-4.0, 1.5, -0.5), 3.0)


def in_room(plane, local):
    """The board's own frame to the room's, by the quaternion that viser is given."""
    w, x, y, z = plane.wxyz
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return local @ turn.T + np.array(plane.center_m)


def test_a_ray_through_a_dot_hits_its_place(plane, rng):
    dots = plane.in_scene(plane.latent_map.rooms)
    by_quaternion = in_room(plane, plane.on_board(plane.latent_map.rooms, 0.0))
    np.testing.assert_allclose(dots, by_quaternion, atol=1e-12)
    for dot, place in zip(dots, plane.latent_map.rooms.tolist(), strict=True):
        eye = rng.uniform([-3, 3, 3], [3, 6, 8])
        np.testing.assert_allclose(plane.hit(eye, 0.3 * (dot - eye)), place, atol=1e-6)  # float32


def test_beside_the_board_the_edge_is_hit_and_away_from_it_nothing(plane):
    eye = np.array([0.0, 5.0, 6.0])
    beside = in_room(plane, np.array([40.0, 0.0, 0.0]))
    x, _ = plane.hit(eye, beside - eye)
    assert x == pytest.approx(plane.latent_map.middle[0] + plane.latent_map.side / 2)
    assert plane.hit(eye, eye - np.array(plane.center_m)) is None
    assert plane.hit(eye, [1.0, 0.0, 0.0]) is None
