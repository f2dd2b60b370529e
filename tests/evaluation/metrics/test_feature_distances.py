"""Distances and shares of features against closed forms, loops, scipy and torchmetrics."""

import math

import numpy as np
import pytest
import scipy.linalg
import torch
from torchmetrics.image.fid import FrechetInceptionDistance
from torchmetrics.image.kid import KernelInceptionDistance
from toy_metrics import Plain, fed

from sceneprior.core.errors import InputError
from sceneprior.evaluation.metrics.picture_distances import (
    frechet_distance,
    in_manifold,
    kernel_distance,
    kernels,
)


def with_moments(count: int, mean: np.ndarray, covariance: np.ndarray, seed: int) -> np.ndarray:
    """Samples whose sample mean and covariance are exactly the given ones."""
    white = np.random.default_rng(seed).normal(size=(count, len(mean)))
    white -= white.mean(0)
    white = white @ np.linalg.inv(np.linalg.cholesky(np.cov(white.T))).T
    return mean + white @ np.linalg.cholesky(covariance).T


def test_fewer_images_than_dimensions_is_exact_too():
    # In 300 dimensions, but living in the first 3: the closed form of those 3 holds.
    var_a, var_b = np.array([1.0, 4.0, 9.0]), np.array([4.0, 4.0, 0.25])
    a, b = np.zeros((20, 300)), np.zeros((15, 300))
    a[:, :3] = with_moments(20, np.zeros(3), np.diag(var_a), 3)
    b[:, :3] = with_moments(15, np.ones(3), np.diag(var_b), 4)
    expected = 3 + ((np.sqrt(var_a) - np.sqrt(var_b)) ** 2).sum()
    turn = scipy.linalg.qr(np.random.default_rng(5).normal(size=(300, 300)))[0]
    assert frechet_distance(a, b) == pytest.approx(expected, abs=1e-10)
    assert frechet_distance(a @ turn, b @ turn) == pytest.approx(expected, abs=1e-9)


def test_distances_refuse_too_few_images_and_broken_numbers():
    with pytest.raises(InputError, match="at least 2 images in either set, but one set has 1"):
        frechet_distance(np.zeros((1, 4)), np.zeros((3, 4)))
    with pytest.raises(InputError, match="not finite"):
        frechet_distance(np.zeros((2, 4)), np.full((3, 4), math.nan))


def test_frechet_distance_is_torchmetrics(two_sets):
    theirs = FrechetInceptionDistance(Plain(), normalize=True, input_img_size=(12, 3, 3)).set_dtype(
        torch.float64
    )
    expected = fed(theirs, *two_sets).item()
    assert frechet_distance(*two_sets) == pytest.approx(expected, rel=1e-6)


def test_counts_stand_for_repeated_rows(two_sets, rng):
    a, b = two_sets
    counts_a, counts_b = rng.integers(0, 3, size=len(a)), rng.integers(0, 3, size=len(b))
    longer_a, longer_b = a.repeat(counts_a, axis=0), b.repeat(counts_b, axis=0)
    expected = frechet_distance(longer_a, longer_b)
    assert frechet_distance(a, b, counts_a, counts_b) == pytest.approx(expected, rel=1e-9)


def test_kernel_distance_is_torchmetrics_where_a_subset_is_the_whole_set(two_sets):
    a, b = two_sets[0][:30], two_sets[1]
    theirs = KernelInceptionDistance(Plain(), subsets=1, subset_size=30, normalize=True)
    mean, _ = fed(theirs.set_dtype(torch.float64), a, b)
    assert kernel_distance(kernels(a, b))[0] == pytest.approx(mean.item(), rel=1e-9)


def test_counts_stand_for_repeated_rows_of_kernels(two_sets, rng):
    a, b = two_sets
    counts_a, counts_b = rng.integers(0, 3, size=len(a)), rng.integers(0, 3, size=len(b))
    longer_a, longer_b = a.repeat(counts_a, axis=0), b.repeat(counts_b, axis=0)
    expected = kernel_distance(kernels(longer_a, longer_b))[0]
    # A row repeated is a pair with itself in the longer set, and none where it is counted.
    own = [
        (counts * (counts - 1)) @ ((rows**2).sum(1) / 12 + 1) ** 3 / (n * (n - 1))
        for rows, counts, n in ((a, counts_a, len(longer_a)), (b, counts_b, len(longer_b)))
    ]
    got = kernel_distance(kernels(a, b), counts_a[None], counts_b[None])
    assert got.shape == (1,) and sum(own) > 0
    assert got[0] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(("n", "m"), [(40, 30), (2, 30), (3, 2)])
def test_precision_and_recall_are_their_definition(two_sets, n, m):
    a, b = two_sets[0][:n], two_sets[1][:m]

    def inside(rows: np.ndarray, manifold: np.ndarray) -> list[bool]:
        answers = []
        for row in rows:
            hit = False
            for index, center in enumerate(manifold):
                others = [np.linalg.norm(x - center) for k, x in enumerate(manifold) if k != index]
                radius = sorted(others)[min(3, len(others)) - 1]
                hit = hit or np.linalg.norm(row - center) <= radius
            answers.append(hit)
        return answers

    precise, covered = in_manifold(a, b), in_manifold(b, a)
    assert precise.tolist() == inside(a, b) and covered.tolist() == inside(b, a)
    assert n < 40 or 0 < precise.mean() < 1 or 0 < covered.mean() < 1
