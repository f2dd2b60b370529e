"""Turns about the vertical axis: by hand, against each other, and exact."""

import numpy as np
import pytest
import torch

from sceneprior.core.boxes import QUARTERS, quarter_rotation, turn_vectors, yaw_rotation


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
