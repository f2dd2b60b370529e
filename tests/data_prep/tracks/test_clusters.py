"""Clusters of masks are compared with all partitions, and are a local optimum."""

import itertools

import numpy as np

from data_prep.tracks.clusters import cluster


def partitions(count):
    """All partitions of `count` items, as labels in the order of first items."""
    for labels in itertools.product(range(count), repeat=count):
        if all(label <= max(labels[:k], default=-1) + 1 for k, label in enumerate(labels)):
            yield np.array(labels)


def total_weight(weights, labels):
    """The sum of the weights of all pairs of different masks in one cluster."""
    return np.triu(weights * (labels[:, None] == labels), 1).sum()


def noisy_weights(rng, truth, noise):
    weights = np.where(truth[:, None] == truth, 1.0, -1.0) + rng.normal(
        scale=noise, size=(len(truth),) * 2
    )
    return (weights + weights.T) / 2


def test_small_problems_are_solved_to_the_best_partition():
    """Greedy contraction is not exact, but optimal in at least 90% of these and never far off."""
    rng = np.random.default_rng(0)
    ratios = []
    for _ in range(40):
        weights = noisy_weights(rng, rng.integers(0, 3, 6), 1.0)
        best = max(total_weight(weights, labels) for labels in partitions(6))
        found = total_weight(weights, cluster(weights))
        ratios.append(found / best if best else 1.0)
    assert np.mean(np.array(ratios) > 1 - 1e-9) >= 0.9 and min(ratios) > 0.8


def test_no_single_move_gains():
    rng = np.random.default_rng(1)
    truth = rng.integers(0, 6, 60)
    weights = noisy_weights(rng, truth, 2.0)
    labels = cluster(weights)
    total = total_weight(weights, labels)
    for k in range(60):
        for other in range(labels.max() + 2):
            moved = labels.copy()
            moved[k] = other
            assert total_weight(weights, moved) <= total + 1e-9
    for one, other in itertools.combinations(range(labels.max() + 1), 2):
        joined = np.where(labels == other, one, labels)
        assert total_weight(weights, joined) <= total + 1e-9
