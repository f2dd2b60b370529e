"""Clusters masks by object: log-odds that two masks show the same object, and their largest sum.

Correlation clustering (Bansal et al., "Correlation clustering", Machine Learning 2004): a positive
weight means that two masks show the same object, a negative weight that they do not. The number of
clusters is not given. Greedy contraction of pairs and moves of single masks alternate until neither
increases the sum (Keuper et al., "Efficient decomposition of image and mesh graphs by lifted
multicuts", ICCV 2015).
"""

import numpy as np
from jaxtyping import Float, Int

from sceneprior.core.classes import VOID

SAME, OTHER = 0.75, 0.08
"""Probability that a cell shown by one mask is also shown by the other mask, for two masks of the
same object and of different objects."""
STRENGTH, ENOUGH = 4.0, 10.0
"""Maximum weight of a pair's geometry, and number of cells at which 63% of it is reached; the
weight saturates because a surface's cells are not independent observations."""
CLASS_ERROR = 0.05
"""Assumed share of masks with a wrong class."""
SAME_VIEW = -4.0
"""Weight of two masks in the same view: an object has one mask per view, unless it is split."""
ID_MEANS = 0.3
"""Ids are used if at least this share of the pairs within clusters has equal ids, and if the share
among pairs of different clusters is below this multiple of the former."""
_ROUNDS = 10
_SWEEPS = 20


def pair_weights(
    shown: Int[np.ndarray, "cells views"],
    mask_view: Int[np.ndarray, " masks"],
    mask_class: Int[np.ndarray, " masks"],
) -> Float[np.ndarray, "masks masks"]:
    """Weight of each pair of masks, from the cells that the views of both masks see.

    Mask a shows n cells that b's view also sees, and b shows the share q of these. The log-odds

        q log(SAME / OTHER) + (1 - q) log((1 - SAME) / (1 - OTHER))

    are computed in both directions, averaged, and weighted by STRENGTH (1 - exp(-n / ENOUGH)). The
    log-odds of equal or unequal classes are added, with the same weight but without STRENGTH.
    `shown` is that of `Surface`.
    """
    count = len(mask_view)
    member = np.zeros((len(shown), count + 1), dtype=np.float32)
    cells, views = np.nonzero(shown > 0)
    member[cells, shown[cells, views]] = 1
    member = member[:, 1:]
    both = (member.T @ member).astype(np.float64)
    seen = (member.T @ (shown >= 0).astype(np.float32))[:, mask_view].astype(np.float64)
    share = both / np.maximum(seen, 1)
    known = 1 - np.exp(-seen / ENOUGH)
    odds = share * np.log(SAME / OTHER) + (1 - share) * np.log((1 - SAME) / (1 - OTHER))
    weights = STRENGTH * odds * known
    weights = (weights + weights.T) / 2
    equal, unequal = class_odds(mask_class, 2 * CLASS_ERROR)
    same_class = mask_class[:, None] == mask_class
    weights += np.where(same_class, equal, unequal) * np.minimum(known, known.T)
    weights[mask_view[:, None] == mask_view] = SAME_VIEW
    return weights


def class_odds(mask_class: Int[np.ndarray, " masks"], error: float) -> tuple[float, float]:
    """Log-odds that two masks or clusters show the same object, if their classes are equal and if
    they differ; `error` is the probability that the classes of one object differ."""
    frequency = np.bincount(mask_class) / len(mask_class)
    agree = float((frequency**2).sum())
    return float(np.log((1 - error) / agree)), float(np.log(error / (1 - agree + 1e-3)))


def id_odds(
    given: Int[np.ndarray, " masks"],
    labels: Int[np.ndarray, " masks"],
    mask_view: Int[np.ndarray, " masks"],
) -> Float[np.ndarray, "masks masks"] | None:
    """Log-odds that each pair of masks shows the same object, from the ids that the data gives
    them; None if these ids are inconsistent across views. Their error rates are measured on
    clusters (`labels`) that were found without ids."""
    other_view = mask_view[:, None] != mask_view
    same_id, same = given[:, None] == given, labels[:, None] == labels
    if not (other_view & same).any() or not (other_view & ~same).any():
        return None
    within, between = same_id[other_view & same].mean(), same_id[other_view & ~same].mean()
    if within < ID_MEANS or between > ID_MEANS * within:
        return None
    within, between = np.clip([within, between], 0.02, 0.98)
    odds = np.where(same_id, np.log(within / between), np.log((1 - within) / (1 - between)))
    return np.where(other_view, odds, 0.0)


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
    """The most frequent class among the masks of each cluster; void loses ties."""
    votes = [2 * np.bincount(mask_class[labels == k]) for k in range(int(labels.max()) + 1)]
    return np.array([(own - (np.arange(len(own)) == VOID)).argmax() for own in votes])


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
