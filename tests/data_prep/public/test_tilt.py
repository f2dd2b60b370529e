"""Tilted image planes against their projection, ray by ray and pixel by pixel."""

import numpy as np
import pytest
from public_files import cam_from_uv, furnished

from data_prep.readers.tilt import pinhole, straight_grid


@pytest.mark.parametrize("shifts", [(0.0, 0.0), (0.3, 0.0), (-0.8, 0.0), (-0.07, -0.17)])
def test_a_tilted_image_plane_is_that_of_a_turned_pinhole(tmp_path, numbers, shifts):
    projection = 1.7 * cam_from_uv(furnished(tmp_path), *shifts)
    intrinsics, turn = pinhole(projection, (96, 128))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) > 0 and np.abs(np.tril(intrinsics, -1)).max() < 1e-12
    for u, v in numbers.uniform(-1, 1, (20, 2)):
        ray = projection @ (u, v, 1) * (1, -1, -1)  # to OpenCV's axes
        assert ray[2] > 0
        x, y, w = intrinsics @ turn @ ray
        np.testing.assert_allclose([x / w, y / w], [64 * (u + 1), 48 * (1 - v)], atol=1e-9)


def test_a_skewed_grid_is_straightened_pixel_by_pixel():
    K = np.array([[80.0, 9, 30], [0, 70, 21], [0, 0, 1]])
    straight = K * (1 - np.eye(3)[0][:, None] * np.eye(3)[1])
    lines = np.ix_(np.arange(40), np.arange(60))
    (rows, columns), inside = straight_grid(lines, K, (40, 60))
    for row, column in np.ndindex(40, 60):
        x, y, _ = K @ np.linalg.solve(straight, (column + 0.5, row + 0.5, 1))
        assert inside[row, column] == (0 <= x < 60)
        if inside[row, column]:
            assert (rows[row, column], columns[row, column]) == (int(y), int(x))
    assert 0 < (~inside).sum() < 100
    (_, same), all_of_it = straight_grid(lines, straight, (40, 60))
    assert (same == np.arange(60)).all() and all_of_it.all()
