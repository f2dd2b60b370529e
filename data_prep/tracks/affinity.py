"""Weights of pairs of masks: log-odds that both masks show the same object."""

import numpy as np
from jaxtyping import Float, Int

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
