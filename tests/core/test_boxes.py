"""Corners of boxes, rotations, and template meshes."""

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull
from torch.testing import assert_close

from sceneprior.core.boxes import (
    QUARTERS,
    quarter_rotation,
    turn_vectors,
    yaw_rotation,
)
from sceneprior.core.proxies import beveled_cube


def test_a_yaw_turns_z_towards_x():
    many = yaw_rotation(np.array([[0.3], [-2.0]]))
    assert many.shape == (2, 1, 3, 3)
    np.testing.assert_allclose(many[0, 0] @ [0, 0, 1], [np.sin(0.3), 0, np.cos(0.3)], atol=1e-16)
    np.testing.assert_allclose(many[1, 0] @ many[1, 0].T, np.eye(3), atol=1e-16)
    assert np.linalg.det(many[1, 0]) == pytest.approx(1)
    np.testing.assert_array_equal(yaw_rotation(-2.0), many[1, 0])


@pytest.mark.parametrize("quarters", range(-1, 6))
def test_a_quarter_rotation_is_a_yaw_without_rounding(quarters):
    turn = quarter_rotation(quarters)
    np.testing.assert_allclose(turn, yaw_rotation(quarters * np.pi / 2), atol=1e-14)
    assert set(np.unique(turn)) == {0.0, 1.0} | ({-1.0} if quarters % QUARTERS else set())


def test_vectors_turn_as_their_rotation_says(torch_rng):
    vectors = torch.randn(QUARTERS, 5, 2, 3, generator=torch_rng, dtype=torch.float64)
    turned = turn_vectors(vectors, torch.arange(QUARTERS))
    for quarters in range(QUARTERS):
        by_matrix = vectors[quarters] @ torch.from_numpy(quarter_rotation(quarters)).T
        assert torch.equal(turned[quarters], by_matrix)


@pytest.mark.parametrize(
    "upright, level, volume",
    [
        (0.0, 0.0, 8.0),
        (1.0, 0.0, 4.0),  # a prism over the diamond of area 2
        (1.0, 1.0, 4 / 3),  # an octahedron
        # Below |y| = 1 - b the octagon of area 4 - 2 a^2; above it shrinks evenly to 1 - b of it.
        (0.4, 0.5, (4 - 2 * 0.4**2) * 2 * (0.5 + 0.5 * (1 + 0.5 + 0.25) / 3)),
    ],
)
def test_a_beveled_cube_touches_all_six_sides_and_has_its_volume(upright, level, volume):
    vertices = beveled_cube(torch.tensor([upright, level], dtype=torch.float64))
    one = torch.ones(3, dtype=torch.float64)
    assert_close(vertices.amax(dim=0), one)
    assert_close(vertices.amin(dim=0), -one)
    assert ConvexHull(vertices.numpy()).volume == pytest.approx(volume)


def test_gradients_of_bevels_in_double_precision():
    bevels = torch.tensor([[0.2, 0.7], [0.5, 0.1]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(beveled_cube, bevels)
