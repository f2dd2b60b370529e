"""Parts fitted to rays: furniture is found again, cleanly and always the same."""

import numpy as np
import pytest
import trimesh
from parts_of_rooms import CORNER, TABLE, boxes, rays_of

from sceneprior.core.boxes import turn_grids
from sceneprior.core.parts import (
    CYLINDER,
    MOST_CORNERS,
    SQUARE,
    Parts,
    filled_cells,
    surface_of_parts,
)
from sceneprior.lifted.lifting import RayPool
from sceneprior.lifted.lifting.part_fit import fit_parts
from sceneprior.lifted.lifting.part_loss import RayFit, area_table, stability
from sceneprior.lifted.lifting.prototype_fitting import explain_rays, fit_prototypes
from sceneprior.lifted.prototypes import POSES, Prototypes, pose_rotation, turn_of, turned_extents

MARGIN, CELLS = 1.1, 32


def fitted(parts: Parts, hangs: bool = False) -> Parts:
    return fit_parts(rays_of(parts, 4000), filled_cells(parts, CELLS, MARGIN), MARGIN, hangs)


def found_again(parts: Parts):
    found = fitted(parts)
    ours, true = (filled_cells(each, 64, 1.0) for each in (found, parts))
    return found, (ours & true).sum() / (ours | true).sum()


@pytest.mark.parametrize(("parts", "most"), [(TABLE, 3), (CORNER, 4)])
def test_furniture_is_found_again_in_as_few_parts(parts, most):
    found, iou = found_again(parts)
    assert iou > 0.9 and len(found.kind) <= most


def stability_of(found: Parts, hangs: bool) -> tuple[int, int, float]:
    levels = np.rint((found.ends + 0.5) * 64).astype(np.int64)
    return stability(found.mirrored, levels, area_table(found.outline, 64), hangs)


def test_nothing_floats():
    """Masks show two mattresses of a bunk bed, but no posts; a lamp and its cap, but no cord."""
    found = fitted(boxes((0, 64, 8, 20, 0, 64), (0, 64, 48, 64, 0, 64)))
    assert stability_of(found, False)[:2] == (0, 1)
    filled = filled_cells(found, 64, 1.0)
    assert filled[:, 14].mean() > 0.9 and filled[:, 34].mean() < 0.05, "posts, not a block"
    found = fitted(boxes((0, 64, 0, 20, 0, 64), (24, 40, 60, 64, 24, 40)), hangs=True)
    assert stability_of(found, True)[:2] == (0, 1)
    assert filled_cells(found, 64, 1.0)[:, 30].sum() <= 64, "a thin cord"


@pytest.mark.parametrize("foot", [(0, 8, 0, 56, 0, 8), (0, 20, 0, 56, 0, 64)], ids=["leg", "block"])
def test_furniture_that_stands_does_not_tip_over(foot):
    """Masks show one leg of a table alone, or one side of a desk; an object that hangs may have
    one."""
    shown = boxes((0, 64, 56, 64, 0, 64), foot)
    stands, hangs = (stability_of(fitted(shown, hangs), False)[2] for hangs in (False, True))
    assert stands == 0 < hangs


def test_objects_without_rays_are_their_box():
    nothing = RayPool(np.zeros((5, 3)), np.zeros((5, 3)), np.zeros(5, bool))
    found = fit_parts(nothing, np.zeros((CELLS,) * 3, bool), MARGIN, False)
    np.testing.assert_array_equal(found.ends, [[[-0.5, 0.5]] * 3])


def test_the_loss_is_the_formula_of_the_docstring():
    rays = rays_of(TABLE, 500)
    fit = RayFit(rays, MARGIN, SQUARE, False)
    ends = np.rint((TABLE.ends + 0.5) * 64).astype(np.int64)
    guess = fit.guess(TABLE.kind, TABLE.mirrored, ends)
    volume = 1 * 8 / 64 + 4 * (8 / 64) * (56 / 64) * (8 / 64)
    # Three planes: below the top, and the inner sides of the legs along x and z.
    assert fit.loss(guess) == pytest.approx(0.002 * 2 + 0.002 * 3 - 0.0005 * volume)
    upper = fit.guess(TABLE.kind[:1], TABLE.mirrored[:1], ends[:1])
    missed = (fit.hits & (upper.met_by == 0)).sum()
    assert fit.loss(upper) == pytest.approx(
        0.5 * missed / (rays.hits.sum() + 50) + 0.002 + 0.002 - 0.0005 / 8 + 0.06 * 56 / 64
    )


def test_a_round_bench_keeps_its_outline():
    """Parts that reach beyond it are cut, in the cells and in the mesh."""
    ends = np.array([[[-0.5, 0.5]] * 3])
    bench = Parts(np.array([CYLINDER]), np.array([0]), ends)
    found, iou = found_again(bench)
    assert iou > 0.9 and 8 <= len(found.outline) <= MOST_CORNERS
    vertices, faces = surface_of_parts(found)
    mesh = trimesh.Trimesh(vertices, faces)
    assert mesh.is_volume and mesh.volume == pytest.approx(np.pi / 4, rel=0.08)


def test_objects_in_all_poses_teach_one_kind_and_are_known_again_by_their_rays():
    """A corner in all eight poses, and two tables."""
    hull = filled_cells(CORNER, CELLS, MARGIN)
    hulls = [turn_grids(hull[None], *turn_of(pose))[0] for pose in range(POSES)]
    hulls += [filled_cells(TABLE, CELLS, MARGIN)] * 2
    pools = []
    for pose in range(POSES):
        pool, back = rays_of(CORNER, 800, pose), pose_rotation(pose).T
        pools.append(RayPool(pool.starts @ back, pool.spans @ back, pool.hits))
    pools += [rays_of(TABLE, 800, 8 + seed) for seed in range(2)]
    rays = RayPool(*(np.stack(part) for part in zip(*pools, strict=True)))
    size_m = np.array([[1.2, 0.8, 0.6]])
    sizes_m = np.concatenate(
        [*(turned_extents(size_m, pose) for pose in range(POSES)), size_m, size_m]
    )
    classes = np.array([1] * POSES + [2] * 2)
    items, usable = np.array([0, 8]), np.ones(10, bool)
    parts = fit_prototypes(items, np.stack(hulls), rays, sizes_m, classes, usable, ~usable, MARGIN)
    for found, true in zip(parts, (CORNER, TABLE), strict=True):
        ours, wanted = (filled_cells(each, CELLS, MARGIN) for each in (found, true))
        assert (ours & wanted).sum() > 0.85 * (ours | wanted).sum()
    grids = np.stack([filled_cells(each, CELLS, MARGIN) for each in parts])
    kinds = Prototypes(parts, grids, sizes_m[items], classes[items], np.ones(2, bool))
    looks, errors = explain_rays(kinds, rays, sizes_m, classes, MARGIN)
    assert (errors.argmin(axis=1) == looks % POSES).all()
    assert looks[:POSES].tolist() == list(range(POSES))
    assert (looks[POSES:] // POSES == 1).all()
    nobody, _ = explain_rays(kinds, rays, sizes_m, np.full(10, 3), MARGIN)
    assert (nobody == -1).all(), "no prototype of this class"


def test_looks_are_those_of_the_smallest_of_all_errors():
    """Looks agree with the errors of each object with each prototype alone."""
    rng = np.random.default_rng(3)
    parts, count = (CORNER, TABLE, boxes((0, 64, 0, 64, 0, 64)), CORNER), 24
    pools = [rays_of(parts[row % 3], 200, row) for row in range(count)]
    rays = RayPool(*(np.stack(part) for part in zip(*pools, strict=True)))
    rays.hits[:] ^= rng.random(rays.hits.shape) < 0.2
    sizes_m, classes = rng.uniform(0.4, 1.2, (count, 3)), np.ones(count, np.int64)
    prototypes_m = rng.uniform(0.4, 1.2, (4, 3))
    prototypes_m[3] = prototypes_m[0]  # ties give the first
    grids = np.stack([filled_cells(each, CELLS, MARGIN) for each in parts])

    def kinds(rows: list[int]) -> Prototypes:
        return Prototypes(
            tuple(parts[row] for row in rows), grids[rows], prototypes_m[rows],
            np.ones(len(rows), np.int64), np.ones(len(rows), bool),
        )  # fmt: skip

    looks, errors = explain_rays(kinds([0, 1, 2, 3]), rays, sizes_m, classes, MARGIN)
    alone = [explain_rays(kinds([row]), rays, sizes_m, classes, MARGIN)[1] for row in range(4)]
    every = np.stack(alone, axis=1)
    assert np.array_equal(looks, every.reshape(count, -1).argmin(axis=1))
    assert np.array_equal(errors, every[np.arange(count), looks // POSES])
    assert len(np.unique(looks // POSES)) == 3
