"""Weights of pairs of masks: log-odds that two masks show one object."""

import numpy as np
from jaxtyping import Float, Int

SAME, OTHER = 0.75, 0.08
"""Probability that a cell shown by one mask is also shown by the other mask, for two masks of the
same object and of different objects."""
STRENGTH, ENOUGH = 4.0, 10.0
"""Weight of a pair's geometry, and the number of cells at which 63% of this weight is reached: the
cells of a surface are not independent observations."""
CLASS_ERROR = 0.05
"""Assumed share of wrong classes."""
ONE_VIEW = -4.0
"""Weight of two masks of one view: an object has one mask, unless the mask is split."""
ID_MEANS = 0.3
"""Ids mean something if this share of the pairs in a cluster has equal ids, and unequal clusters
have less than this part of that."""


def pair_weights(
    shown: Int[np.ndarray, "cells views"],
    mask_view: Int[np.ndarray, " masks"],
    mask_class: Int[np.ndarray, " masks"],
) -> Float[np.ndarray, "masks masks"]:
    """Weigh each pair of masks by the cells that both of their views see.

    Of the n cells that mask a shows and the view of b sees, the share q is shown by b. The
    log-odds q log(SAME / OTHER) + (1 - q) log((1 - SAME) / (1 - OTHER)) are taken both ways,
    averaged, and weighed by STRENGTH (1 - exp(-n / ENOUGH)), as are the log-odds of equal or
    unequal classes (without STRENGTH). `shown` is that of `rays.surface`.
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
    weights += class_odds(mask_class)[mask_class[:, None], mask_class] * np.minimum(known, known.T)
    weights[mask_view[:, None] == mask_view] = ONE_VIEW
    return weights


def class_odds(mask_class: Int[np.ndarray, " masks"]) -> Float[np.ndarray, "classes classes"]:
    """Log-odds that masks of two classes show one object, at an error rate of `CLASS_ERROR`."""
    share = np.bincount(mask_class) / len(mask_class)
    agree = (share**2).sum()
    unequal = np.log(2 * CLASS_ERROR / (1 - agree + 1e-3))
    equal = np.log((1 - 2 * CLASS_ERROR) / agree)
    return np.where(np.eye(len(share), dtype=bool), equal, unequal)


def id_odds(
    given: Int[np.ndarray, " masks"],
    labels: Int[np.ndarray, " masks"],
    mask_view: Int[np.ndarray, " masks"],
) -> Float[np.ndarray, "masks masks"] | None:
    """Log-odds that masks show one object by their ids, whose error rates are counted in clusters
    found without them; None if ids mean nothing across views."""
    apart = mask_view[:, None] != mask_view
    same_id, same = given[:, None] == given, labels[:, None] == labels
    if not (apart & same).any() or not (apart & ~same).any():
        return None
    within, between = same_id[apart & same].mean(), same_id[apart & ~same].mean()
    if within < ID_MEANS or between > ID_MEANS * within:
        return None
    within, between = np.clip([within, between], 0.02, 0.98)
    odds = np.where(same_id, np.log(within / between), np.log((1 - within) / (1 - between)))
    return np.where(apart, odds, 0.0)
