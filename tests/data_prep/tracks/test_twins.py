"""The compiled loops of data_prep/tracks against loops that read as their definitions."""

import functools

import numpy as np
import pytest
from untracked_room import frames, furnished

from data_prep.tracks.carving import BEHIND, CLEAR_M, cameras_of, fill, first_hits, surface, widened
from data_prep.tracks.clusters import pair_weights
from data_prep.tracks.merging import EVERY, hull_coverage


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Ids at every fourth pixel, true objects, cameras and the grid of four views."""
    masks, true, poses, lenses = frames(furnished(tmp_path_factory.mktemp("room")))
    ids = np.ascontiguousarray(masks.ids[::3, ::4, ::4])
    ids[ids > 0] = np.unique(ids[ids > 0], return_inverse=True)[1] + 1
    kept = np.unique(masks.ids[::3, ::4, ::4])
    cameras = cameras_of(poses[::3], lenses[::3], 4)
    return ids, true[kept[kept > 0]], cameras, fill(ids, cameras)


def seen_at(cameras, view, point):
    """Column, row and depth of a world point."""
    u, v, depth = cameras.to_image[view] @ np.append(point, 1.0)
    return u / depth, v / depth, depth


def middle(grid, cell):
    return grid.low_m + (np.asarray(cell) + 0.5) * grid.cell_m


def test_sampled_cameras_see_what_the_whole_ones_do(scene):
    """Pixel (i, j) of a sampled image is pixel (4 i, 4 j) of the whole one."""
    *_, poses, lenses = frames(furnished(None))
    whole, sampled = cameras_of(poses, lenses, 1), cameras_of(poses, lenses, 4)
    point = np.array([0.3, 0.2, 0.7])
    for view in range(len(poses)):
        (u, v, far), (a, b, near) = (seen_at(one, view, point) for one in (whole, sampled))
        assert np.allclose([(u - 0.5) / 4 + 0.5, (v - 0.5) / 4 + 0.5, far], [a, b, near])
        ray = sampled.eyes_m[view] + near * sampled.rays[view] @ [a, b, 1.0]
        assert np.allclose(ray, point)


def cells_along(cameras, grid, view, row, column, stride_cells):
    """Depths and filled cells at even steps of a pixel's ray, from where it enters the grid."""
    eye, way = cameras.eyes_m[view], cameras.rays[view] @ [column + 0.5, row + 0.5, 1.0]
    ends = (grid.low_m - eye + np.outer([0, 1], grid.filled.shape) * grid.cell_m) / way
    near, far = max(0.0, ends.min(axis=0).max()), ends.max(axis=0).min()
    stride = stride_cells * grid.cell_m / np.linalg.norm(way)
    t = near + 0.5 * stride
    while t < far:
        cell = np.trunc((eye + t * way - grid.low_m) / grid.cell_m).astype(int)
        if (cell >= 0).all() and (cell < grid.filled.shape).all() and grid.filled[tuple(cell)]:
            yield t, tuple(cell.tolist())
        t += stride


def test_filled_cells_hold_the_boxes(scene):
    """Cells inside bed and cabinet are filled, those near a camera are not."""
    *_, cameras, grid = scene
    for cell in np.argwhere(grid.filled)[::50]:
        assert np.linalg.norm(cameras.eyes_m - middle(grid, cell), axis=1).min() >= CLEAR_M
    for point in ([-0.2, 0.1, 0.25], [-1.65, -0.1, 0.9]):
        assert grid.filled[tuple(((point - grid.low_m) / grid.cell_m).astype(int))]
    ids = scene[0]
    for cell in np.argwhere(grid.filled)[::100]:
        spots = [(view, *seen_at(cameras, view, middle(grid, cell))) for view in range(len(ids))]
        masks = [
            far > 0.1
            and 0 <= u < ids.shape[2]
            and 0 <= v < ids.shape[1]
            and ids[view, int(v), int(u)] > 0
            for view, u, v, far in spots
        ]
        assert sum(masks) >= 2


def test_first_hits_and_surface(scene):
    ids, _, cameras, grid = scene
    depth = first_hits(ids, cameras.eyes_m, cameras.rays, *grid)
    rng = np.random.default_rng(0)
    for view, row, column in rng.permutation(np.argwhere(ids > 0))[:60].tolist():
        first = next(cells_along(cameras, grid, view, row, column, 0.5), (np.inf, ()))[0]
        assert np.isclose(depth[view, row, column], first, rtol=1e-6)  # float32
    assert np.isinf(depth[ids <= 0]).all()
    cells, shown = surface(ids, ids, cameras, grid)
    for k in rng.permutation(len(cells))[:60]:
        for view in range(len(ids)):
            u, v, far = seen_at(cameras, view, middle(grid, cells[k]))
            expected = -1
            if far > 0.1 and 0 <= u < ids.shape[2] and 0 <= v < ids.shape[1]:
                number = ids[view, int(v), int(u)]
                behind = far > depth[view, int(v), int(u)] + BEHIND * grid.cell_m
                expected = -1 if number > 0 and behind else number
            assert shown[k, view] == expected


def test_widened_masks_keep_other_masks(scene):
    ids = scene[0]
    wide = widened(ids)
    assert (wide[ids != 0] == ids[ids != 0]).all() and (wide > 0).sum() > (ids > 0).sum()
    for view, row, column in np.argwhere((wide > 0) & (ids == 0))[::40]:
        around = ids[view, max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        assert wide[view, row, column] in around


def test_hull_coverage(scene):
    """A ray is explained by a cluster if a cell on it is in the cluster's hull, counted by hand."""
    ids, true, cameras, grid = scene
    labels = np.unique(true, return_inverse=True)[1]
    near = widened(ids)
    share = hull_coverage(ids, near, labels, cameras, grid)

    @functools.cache
    def counted(cell):
        own, past = np.zeros(share.shape[1]), 0
        for view in range(len(ids)):
            u, v, far = seen_at(cameras, view, middle(grid, cell))
            if far < 0.1 or not (0 <= u < ids.shape[2] and 0 <= v < ids.shape[1]):
                continue
            number = near[view, int(v), int(u)]
            past += number == 0
            if number > 0:
                own[labels[number - 1]] += 1
        return own, past

    def views_of(cell):
        own, past = counted(cell)
        return own.copy(), past

    mask = int(np.bincount(ids[ids > 0])[1:].argmax())
    met, count = np.zeros(share.shape[1]), 0
    view = int(np.argwhere(ids == mask + 1)[0, 0])
    for row, column in np.argwhere(ids[view] == mask + 1).tolist():
        if row % EVERY or column % EVERY:
            continue
        count += 1
        passed = np.zeros(share.shape[1], dtype=bool)
        for _, cell in cells_along(cameras, grid, view, row, column, 0.7):
            own, past = views_of(cell)
            own[labels[mask]] -= 1
            passed |= (own >= 2) & (past <= 0.3 * (own + past) + 0.5)
        met += passed
    np.testing.assert_allclose(share[mask], met / count, atol=1e-12)
    assert share[mask].max() > 0.5


def test_pair_weights_by_hand():
    shown = np.array([[1, 3], [1, 3], [1, 4], [2, 4], [2, -1], [0, 3]])
    view, classes = np.array([0, 0, 1, 1]), np.array([1, 2, 1, 2])
    weights = pair_weights(shown, view, classes)
    assert (weights == weights.T).all()
    assert weights[0, 1] == weights[2, 3] == -4

    def odds(share):
        return share * np.log(0.75 / 0.08) + (1 - share) * np.log(0.25 / 0.92)

    def known(cells):
        return 1 - np.exp(-cells / 10)

    # Mask 1 has three cells that view 1 sees, two of them in mask 3, which has three that view 0
    # sees. Classes agree, at chance in half of the pairs.
    expected = 4 * odds(2 / 3) * known(3) + np.log(0.9 / 0.5) * known(3)
    assert np.isclose(weights[0, 2], expected)
