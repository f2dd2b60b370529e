"""Thinned hulls: gradients against torch, lookalikes found again, what rays need is kept."""

import numpy as np
import pytest
import torch
from references import fields

from sceneprior.core.geometry.turns import turn_grids
from sceneprior.lifted.lifting.lookalikes import Lookalike, lookalikes, moved_vectors
from sceneprior.lifted.lifting.rays import RayPool
from sceneprior.lifted.lifting.thinning import ray_slope, regular_slope, thin_shapes

CELLS = 24


@pytest.fixture
def rays() -> RayPool:
    """Through the frame, most of them; the first starts inside, the second has no span, the third
    runs level along a side, the fourth goes past the frame."""
    rng = np.random.default_rng(0)
    starts = rng.uniform(-1, 1, (30, 3))
    spans = rng.uniform(-1, 1, (30, 3)) - starts
    starts[0], spans[1] = 0, 0
    starts[2], spans[2] = [-1, 1, 0.3], [2, 0, 0]
    starts[3], spans[3] = [-1, 1.4, 0], [2, 0.3, 0.1]
    return RayPool(starts, spans, rng.random(30) < 0.5)


def test_the_slope_of_rays_is_autograds(rays):
    rng = np.random.default_rng(1)
    logits, offsets = rng.standard_normal((5, 5, 5)), rng.random(30)
    slope = np.zeros_like(logits)
    ray_slope(logits, *rays, offsets, 7, slope)
    variable = torch.from_numpy(logits).requires_grad_()
    entropy = fields.ray_entropy(
        variable, *(torch.from_numpy(part) for part in rays), torch.from_numpy(offsets), 7
    )
    (wanted,) = torch.autograd.grad(entropy, variable)
    np.testing.assert_allclose(slope, wanted.numpy(), rtol=0, atol=1e-12)
    assert torch.autograd.gradcheck(
        lambda grid: fields.ray_entropy(
            grid, *(torch.from_numpy(part) for part in rays), torch.from_numpy(offsets), 7
        ),
        variable,
    )


def test_the_slope_of_variation_and_volume_is_autograds():
    logits = np.random.default_rng(2).standard_normal((5, 5, 5))
    slope = np.full_like(logits, np.nan)
    regular_slope(1 / (1 + np.exp(-logits)), 0.3, 0.1, slope)
    variable = torch.from_numpy(logits).requires_grad_()
    (wanted,) = torch.autograd.grad(fields.regularity(variable, 0.3, 0.1), variable)
    np.testing.assert_allclose(slope, wanted.numpy(), rtol=0, atol=1e-12)


def chair() -> np.ndarray:
    """A seat, a back on the side of low z, and one arm at high x."""
    grid = np.zeros((CELLS, CELLS, CELLS), bool)
    grid[4:20, 6:11, 4:20] = grid[4:20, 6:22, 4:7] = grid[17:20, 6:15, 4:20] = True
    return grid


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("quarters", range(4))
def test_a_turned_and_mirrored_twin_is_found_with_how_it_was_moved(quarters, mirrored):
    other = turn_grids(chair()[None], quarters, mirrored)[0]
    sizes = np.array([[0.5, 1.0, 0.6]] * 2)
    sizes[1] = sizes[1][::-1] if quarters % 2 else sizes[1]
    grids = np.stack([chair(), other, chair(), np.zeros_like(chair())])
    sizes = np.concatenate([sizes, sizes[:1], sizes[:1]])
    found = lookalikes(grids, sizes, np.array([1, 1, 2, 1]))
    # What brings the other onto the first.
    best = found[0][0]
    np.testing.assert_array_equal(turn_grids(other[None], *best[1:])[0], chair())
    assert best.item == 1 and all(each.item in (0, 1) for each in found[0]), "of its class alone"
    assert Lookalike(0, 0, False) not in found[0] and found[3] == []


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("quarters", range(4))
def test_vectors_move_with_grids(quarters, mirrored):
    grid = np.random.default_rng(0).random((1, 5, 5, 5)) < 0.3
    cells = np.argwhere(grid[0])
    moved = moved_vectors(cells - 2.0, quarters, mirrored) + 2
    np.testing.assert_array_equal(
        sorted(moved.tolist()), np.argwhere(turn_grids(grid, quarters, mirrored)[0]).tolist()
    )


def meet(grid: np.ndarray, starts: np.ndarray, spans: np.ndarray) -> np.ndarray:
    """Whether rays pass a cell of the grid."""
    places = starts[:, None] + np.linspace(0, 1, 100)[:, None] * spans[:, None]
    cells = ((places + 1) / 2 * len(grid)).astype(int).clip(0, len(grid) - 1)
    return grid[tuple(np.moveaxis(cells, -1, 0))].any(axis=1)


def seen_from_above(grid: np.ndarray, count: int = 3000) -> RayPool:
    """Rays downwards at all slants, and whether they meet the cells."""
    rng = np.random.default_rng(0)
    starts = np.column_stack([rng.uniform(-1, 1, count), np.ones(count), rng.uniform(-1, 1, count)])
    ends = np.column_stack([rng.uniform(-1, 1, count), -np.ones(count), rng.uniform(-1, 1, count)])
    spans = ends - starts
    return RayPool(starts[None], spans[None], meet(grid, starts, spans)[None])


def test_a_dome_that_no_ray_needs_goes_and_a_seat_and_a_back_stay():
    true = chair()
    hull = true.copy()
    for height in range(11, 22):
        hull[4:20, height, 4 : 29 - height] = True  # a ramp from the back down to the seat's front
    rays = seen_from_above(true)
    thin = thin_shapes(hull[None], rays, np.ones((1, 3)), np.array([1]))[0]
    assert not thin[~hull].any()
    starts, spans, hits = (part[0] for part in rays)
    assert meet(thin, starts, spans)[hits].mean() > 0.99, "what rays need is kept"
    assert thin[hull & ~true].mean() < 0.7
    again = thin_shapes(hull[None], rays, np.ones((1, 3)), np.array([1]))[0]
    np.testing.assert_array_equal(thin, again)


def test_an_empty_hull_stays_empty_and_no_objects_are_none(rays):
    none = RayPool(*(part[None] for part in rays))
    empty = np.zeros((1, 8, 8, 8), bool)
    assert not thin_shapes(empty, none, np.ones((1, 3)), np.array([1])).any()
    nothing = RayPool(*(part[:0] for part in none))
    assert thin_shapes(empty[:0], nothing, np.ones((0, 3)), np.zeros(0, int)).shape[0] == 0
