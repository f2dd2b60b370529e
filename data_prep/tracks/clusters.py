"""Clusters masks so that the sum of the weights of all pairs within clusters is maximal.

Correlation clustering (Bansal et al., "Correlation clustering", Machine Learning 2004): a positive
weight means that two masks show the same object, a negative weight that they do not. The number of
clusters is not given. Greedy contraction of pairs and moves of single masks alternate until neither
increases the sum (Keuper et al., "Efficient decomposition of image and mesh graphs by lifted
multicuts", ICCV 2015).
"""

import numpy as np
from jaxtyping import Float, Int

_ROUNDS = 10
_SWEEPS = 20


def cluster(weights: Float[np.ndarray, "masks masks"]) -> Int[np.ndarray, " masks"]:
    """Number of the cluster of each mask, from 0; `weights` is symmetric."""
    weights = weights.copy()
    np.fill_diagonal(weights, 0.0)
    labels = np.arange(len(weights))
    for _ in range(_ROUNDS):
        before = labels
        labels = _move(weights, _contract(weights, labels))
        if np.array_equal(labels, before):
            break
    return labels


def main_classes(
    labels: Int[np.ndarray, " masks"], mask_class: Int[np.ndarray, " masks"]
) -> Int[np.ndarray, " clusters"]:
    """The most frequent class among the masks of each cluster."""
    clusters = range(int(labels.max()) + 1)
    return np.array([np.bincount(mask_class[labels == k]).argmax() for k in clusters])


def _contract(weights: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Join the two clusters with the largest weight between them, as long as it is positive."""
    member = np.eye(labels.max() + 1)[labels] if len(labels) else np.zeros((0, 0))
    between = member.T @ weights @ member
    np.fill_diagonal(between, -np.inf)
    into = np.arange(len(between))
    best = between.argmax(axis=1) if len(between) else into
    top = between[into, best]
    while len(top) and top.max() > 0:
        one = int(top.argmax())
        other = int(best[one])
        into[into == other] = one
        between[one] += between[other]
        between[:, one] = between[one]
        between[other] = between[:, other] = -np.inf
        between[one, one] = -np.inf
        # Update the rows whose best partner has changed.
        stale = np.flatnonzero((best == one) | (best == other))
        for row in {one, other, *stale.tolist()}:
            best[row] = between[row].argmax()
            top[row] = between[row, best[row]]
        better = between[:, one] > top
        best[better], top[better] = one, between[better, one]
    return _renumbered(into[labels])


def _move(weights: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Move each mask to the cluster that gains most, or to a new one if all others lose."""
    count = len(labels)
    labels = labels.copy()
    gains = np.zeros((count, count + 1))
    for k in range(count):
        gains[:, labels[k]] += weights[:, k]
    for _ in range(_SWEEPS):
        moved = False
        for k in range(count):
            own = labels[k]
            best = int(gains[k].argmax())
            if gains[k, best] <= max(gains[k, own], 0.0) + 1e-9:
                if gains[k, own] >= -1e-9:
                    continue
                # A new cluster gains 0, which is more than staying.
                best = int(np.setdiff1d(np.arange(count + 1), labels)[0])
            gains[:, own] -= weights[:, k]
            gains[:, best] += weights[:, k]
            labels[k] = best
            moved = True
        if not moved:
            break
    return _renumbered(labels)


def _renumbered(labels: np.ndarray) -> np.ndarray:
    """Renumber clusters in the order of their first masks."""
    _, first, back = np.unique(labels, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[back]
