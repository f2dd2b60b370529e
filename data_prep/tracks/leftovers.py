"""Joins small clusters to larger ones whose visual hulls explain their masks."""

import numpy as np
from jaxtyping import Float, Int

from data_prep.tracks.affinity import CLASS_ERROR, class_odds
from data_prep.tracks.clusters import main_classes

ENOUGH = 0.6
"""Share of a mask's rays that must meet a cluster's hull for the hull to favour joining."""
HULL, CLASS, PAIRS, SAME_VIEWS = 4.0, 1.0, 2.0, -2.0
"""Weights of the terms of the gain: hulls, classes, mean pair weight, and common views."""
FEW = 6.0
"""Gain of joining a cluster of one mask to any other cluster, since most objects are visible more
often; for a cluster of n masks, the gain is divided by n."""


def join_leftovers(
    labels: Int[np.ndarray, " masks"],
    share: Float[np.ndarray, "masks clusters"],
    weights: Float[np.ndarray, "masks masks"],
    mask_view: Int[np.ndarray, " masks"],
    mask_class: Int[np.ndarray, " masks"],
) -> Int[np.ndarray, " masks"]:
    """Join each cluster, the smallest first, to the larger cluster with the largest positive gain.

    With the mean share s of the smaller cluster's rays that meet the larger cluster's hull, the
    gain is the sum of

    - HULL times (s - ENOUGH) / (1 - ENOUGH) if s is above ENOUGH, else HULL times 3 (s - ENOUGH),
    - CLASS times the log-odds of the classes,
    - PAIRS times the mean weight of pairs of masks in different views,
    - SAME_VIEWS times the share of the smaller cluster's views that show both clusters, and
    - FEW divided by the smaller cluster's number of masks.
    """
    count = int(labels.max()) + 1
    size = np.bincount(labels, minlength=count)
    masks_in = np.zeros((count, int(mask_view.max()) + 1), dtype=np.int64)
    np.add.at(masks_in, (labels, mask_view), 1)
    member = np.eye(count)[labels]
    between = np.where(mask_view[:, None] == mask_view, 0.0, weights)
    mean = member.T @ between @ member / np.maximum(size[:, None] * size, 1)
    main = main_classes(labels, mask_class)
    equal, unequal = class_odds(mask_class, CLASS_ERROR)
    into = np.arange(count)
    for k in np.argsort(size, kind="stable").tolist():
        own = labels == k
        open_to = (into == np.arange(count)) & (size >= max(2, size[k]))
        open_to[k] = False
        above = (share[own].mean(axis=0) - ENOUGH) / (1 - ENOUGH)
        alike = (mask_class[own][:, None] == main).mean(axis=0)
        common = ((masks_in[k] > 0) & (masks_in > 0)).sum(axis=1) / (masks_in[k] > 0).sum()
        gain = (
            HULL * np.where(above > 0, above, 3 * above * (1 - ENOUGH))
            + CLASS * (alike * equal + (1 - alike) * unequal)
            + PAIRS * mean[k]
            + SAME_VIEWS * common
            + FEW / size[k]
        )
        gain[~open_to] = -np.inf
        best = int(gain.argmax())
        if gain[best] > 0:
            into[k] = best
            masks_in[best] += masks_in[k]
            size[best] += size[k]
    while (into[into] != into).any():
        into = into[into]
    joined: Int[np.ndarray, " masks"] = np.unique(into[labels], return_inverse=True)[1]
    return joined
