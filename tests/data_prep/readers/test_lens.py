"""Lenses distort as OpenCV's models do, and straightened pictures show what a pinhole would."""

import numpy as np
import pytest

from data_prep.readers.posed.cameras import Lens, straighten

K = np.array([[80.0, 0, 63], [0, 82, 49], [0, 0, 1]])
SIZE = (96, 128)
LENSES = [
    Lens((-0.28, 0.07, 0.001, -0.0005, 0.01)),
    Lens((0.1, 0.02, 0.0, 0.002, 0.0)),
    Lens((-0.0024, 0.0, 0.0, 0.0, 0.0)),  # a real phone's
    Lens((0.02, -0.01, 0.003, -0.001), fisheye=True),
    Lens((0.0, 0.0, 0.0, 0.0), fisheye=True),
]


def by_hand(lens, points):
    """The formulas of OpenCV's documentation: (n, 2) on the plane at depth 1 -> distorted."""
    x, y = points.T
    r2 = x * x + y * y
    if lens.fisheye:
        k1, k2, k3, k4 = lens.coefficients
        angle = np.arctan(np.sqrt(r2))
        bent = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8)
        return points * (bent / np.sqrt(r2))[:, None]
    k1, k2, p1, p2, k3 = lens.coefficients
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=1,
    )


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_each_pixel_is_the_nearest_that_saw_its_ray(lens):
    view = straighten(lens, K, SIZE)
    v, u = np.indices(SIZE) + 0.5
    rays = (np.stack([u, v], axis=-1).reshape(-1, 2) - view.intrinsics[:2, 2]) / np.diag(
        view.intrinsics
    )[:2]
    seen = by_hand(lens, rays) * np.diag(K)[:2] + K[:2, 2]
    off = seen - np.stack([view.columns, view.rows], axis=-1).reshape(-1, 2) - 0.5
    # Half a pixel to the nearest centre, and as much again where the rim bends between its points.
    assert np.abs(off).max() <= 1.0 and np.abs(off).mean() < 0.27
    # It is the largest such view: each side of the picture is reached.
    assert view.columns.min() == 0 and view.columns.max() == 127
    assert view.rows.min() == 0 and view.rows.max() == 95
    assert 0 <= view.cut_share < 0.2


def test_of_a_lens_that_sees_more_than_half_the_world_the_middle_is_kept():
    wide = K * [[0.4, 1, 1], [1, 0.4, 1], [1, 1, 1]]  # 115 degrees from the middle at the corners
    view = straighten(Lens((0.0,) * 4, fisheye=True), wide, SIZE)
    assert view.cut_share > 0.5
    half = np.degrees(np.arctan(view.intrinsics[0, 2] / view.intrinsics[0, 0]))
    assert 50 < half <= 65.1
