"""Kernel distances against torchmetrics and over all subsets."""

import pytest
import torch
from torchmetrics.image.kid import KernelInceptionDistance
from toy_metrics import Plain, fed

from sceneprior.evaluation.metrics.kernel_distance import kernel_distance, kernels


def test_kernel_distance_is_torchmetrics_where_a_subset_is_the_whole_set(two_sets):
    a, b = two_sets[0][:30], two_sets[1]
    theirs = KernelInceptionDistance(Plain(), subsets=1, subset_size=30, normalize=True)
    mean, _ = fed(theirs.set_dtype(torch.float64), a, b)
    assert kernel_distance(kernels(a, b))[0] == pytest.approx(mean.item(), rel=1e-9)


def test_counts_stand_for_repeated_rows(two_sets, rng):
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
