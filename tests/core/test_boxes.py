"""Corners and edges of boxes: by hand, and the same in numpy and torch."""

import itertools

import numpy as np
import torch
from torch.testing import assert_close

from sceneprior.core.boxes import BOX_EDGES, box_corners


def test_box_corners_are_center_plus_minus_half_a_size():
    center, size = torch.tensor([1.0, 2, 3]), torch.tensor([0.2, 4, 6])
    by_hand = [
        [1 + x * 0.1, 2 + y * 2, 3 + z * 3] for x, y, z in itertools.product((-1, 1), repeat=3)
    ]
    assert_close(box_corners(center, size), torch.tensor(by_hand))
    assert box_corners(torch.zeros(2, 5, 3), torch.ones(2, 5, 3)).shape == (2, 5, 8, 3)


def test_numpy_and_torch_give_the_same_corners(rng):
    centers, sizes = rng.normal(size=(4, 2, 3)), rng.random((4, 2, 3))
    in_torch = box_corners(torch.from_numpy(centers), torch.from_numpy(sizes))
    np.testing.assert_array_equal(box_corners(centers, sizes), in_torch.numpy())


def test_edges_join_corners_that_differ_in_one_coordinate():
    corners = box_corners(np.array([1.0, 2, 3]), np.array([2.0, 4, 6]))
    lengths = sorted(np.linalg.norm(corners[a] - corners[b]) for a, b in BOX_EDGES)
    assert lengths == [2] * 4 + [4] * 4 + [6] * 4
