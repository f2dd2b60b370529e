"""Improved precision and recall: the shares of pictures inside the other set's manifold.

Source: Kynkaanniemi et al., NeurIPS 2019.
"""

from functools import partial

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.distance import cdist

from sceneprior.evaluation.bootstrap import Estimate, mean_of_rooms
from sceneprior.evaluation.metric import (
    GENERATED,
    PICTURED,
    Comparison,
    Metric,
    RoomSet,
    TableColumn,
)
from sceneprior.evaluation.metrics.contents import emptiness
from sceneprior.evaluation.metrics.frechet import check_features

NEIGHBOUR = 3
"""k of the k-th nearest neighbour, whose distance is a ball's radius; 3 is the authors' setting. In
a set of 3 rows or fewer, the radius is the distance of the farthest row."""


def in_manifold(
    features: Float[np.ndarray, "n dimensions"],
    others: Float[np.ndarray, "m dimensions"],
) -> Bool[np.ndarray, " n"]:
    """True for rows of `features` that lie in the manifold of `others`, computed in float64.

    A set's manifold is the union of balls around its rows, each with the distance to the row's
    `NEIGHBOUR`-th nearest other row as its radius. The balls are closed, so that equal pictures lie
    in each other's balls of radius 0. The mean over generated rows, with real `others`, is
    precision; the mean over real rows, with generated `others`, is recall.
    """
    check_features(features, others)
    features, others = features.astype(np.float64), others.astype(np.float64)
    # Column 0 of the sorted distances is the row itself.
    rank = min(NEIGHBOUR, len(others) - 1)
    radii = np.partition(cdist(others, others), rank, axis=1)[:, rank]
    return np.asarray((cdist(features, others) <= radii).any(1))


def _precision(network: str, rooms: RoomSet, comparison: Comparison) -> Estimate:
    if emptiness(rooms.scenes) is not None:
        return Estimate(None, np.zeros(0))
    inside = in_manifold(rooms.features(network), comparison.test.features(network))
    return mean_of_rooms(inside, rooms.counts, 1.0)


def _recall(network: str, rooms: RoomSet, comparison: Comparison) -> Estimate:
    test = comparison.test
    covered = in_manifold(test.features(network), rooms.features(network))
    return mean_of_rooms(covered, test.counts, 1.0)


def _recall_ratio(network: str, rooms: RoomSet, comparison: Comparison) -> Estimate:
    real = comparison.columns["train_rooms"][f"recall_{network}"]
    return _recall(network, rooms, comparison).over(real)


def _metrics_of(network: str, title: str, column: TableColumn | None) -> tuple[Metric, Metric]:
    return (
        Metric(
            f"precision_{network}", f"Precision, {title}", "share of rooms", "higher",
            partial(_precision, network), PICTURED, network,
            protocol={"precision_recall_k": NEIGHBOUR},
        ),
        Metric(
            f"recall_{network}", f"Recall, {title}", "share of test rooms", "higher",
            partial(_recall, network), PICTURED, network, column=column,
        ),
    )  # fmt: skip


METRICS = (
    *_metrics_of("inception", "Inception", None),
    *_metrics_of(
        "effnet_lite0", "EfficientNet-Lite0",
        TableColumn(
            "recall", 2, "recall: share of test rooms that lie among the pictures of the row"
        ),
    ),
    Metric(
        "recall_ratio", "Recall over that of real training rooms", "1: as varied as real", "higher",
        partial(_recall_ratio, "effnet_lite0"), GENERATED, network="effnet_lite0",
    ),
)  # fmt: skip
