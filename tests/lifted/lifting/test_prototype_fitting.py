"""Kinds of furniture: parts from the rays of all objects of a kind, and looks by rays."""

import numpy as np
import pytest
from parts_of_rooms import CORNER, TABLE, rays_of

from sceneprior.core.boxes import turn_grids
from sceneprior.core.parts import filled_cells
from sceneprior.lifted.lifting import RayPool
from sceneprior.lifted.lifting.prototype_fitting import as_prototype, explain_rays, fit_prototypes
from sceneprior.lifted.prototypes import POSES, Prototypes, turn_of, turned_extents

MARGIN, CELLS = 1.1, 32
SIZE_M = np.array([[1.2, 0.8, 0.6]])


def in_pose(rays: RayPool, pose: int) -> RayPool:
    """The inverse of `as_prototype`, by its matrix."""
    eye = np.eye(3)
    back = as_prototype(RayPool(eye, eye, np.ones(3, bool)), pose).starts
    return RayPool(rays.starts @ np.linalg.inv(back), rays.spans @ np.linalg.inv(back), rays.hits)


@pytest.mark.parametrize("pose", range(POSES))
def test_rays_turn_as_grids_do(pose):
    """Cell centres as rays' starts."""
    middles = (np.arange(4) + 0.5) / 2 - 1
    points = np.stack(np.meshgrid(middles, middles, middles, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = np.random.default_rng(0).random((1, 4, 4, 4))
    turned = turn_grids(grid, *turn_of(pose))[0]
    back = as_prototype(RayPool(points, points, np.ones(64, bool)), pose).starts
    rows = tuple(np.rint((back + 1) * 2 - 0.5).astype(int).T)
    np.testing.assert_array_equal(grid[0][rows], turned.ravel())


def objects():
    """A corner in all eight poses, and two tables; their hulls, rays, sizes and classes."""
    hull = filled_cells(CORNER, CELLS, MARGIN)
    hulls = [turn_grids(hull[None], *turn_of(pose))[0] for pose in range(POSES)]
    pools = [in_pose(rays_of(CORNER, 800, seed), seed) for seed in range(POSES)]
    sizes = [turned_extents(SIZE_M, pose)[0] for pose in range(POSES)]
    hulls += [filled_cells(TABLE, CELLS, MARGIN)] * 2
    pools += [rays_of(TABLE, 800, 8 + seed) for seed in range(2)]
    rays = RayPool(*(np.stack(part) for part in zip(*pools, strict=True)))
    classes = np.array([1] * POSES + [2] * 2)
    return np.stack(hulls), rays, np.stack([*sizes, *[SIZE_M[0]] * 2]), classes


def test_objects_in_all_poses_teach_one_kind_and_are_known_again_by_their_rays():
    hulls, rays, sizes_m, classes = objects()
    items, usable = np.array([0, 8]), np.ones(10, bool)
    parts = fit_prototypes(items, hulls, rays, sizes_m, classes, usable, ~usable, MARGIN)
    for found, true in zip(parts, (CORNER, TABLE), strict=True):
        ours, wanted = (filled_cells(each, CELLS, MARGIN) for each in (found, true))
        assert (ours & wanted).sum() > 0.85 * (ours | wanted).sum()
    grids = np.stack([filled_cells(each, CELLS, MARGIN) for each in parts])
    kinds = Prototypes(parts, grids, sizes_m[items], classes[items], np.ones(2, bool))
    looks = explain_rays(kinds, rays, sizes_m, classes, MARGIN)
    assert looks[:POSES].tolist() == list(range(POSES))
    assert (looks[POSES:] // POSES == 1).all()
    nobody = explain_rays(kinds, rays, sizes_m, np.full(10, 3), MARGIN)
    assert (nobody == -1).all(), "no prototype of this class"
