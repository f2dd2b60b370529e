"""Frechet distance between two sets of pictures in a network's features, and the gap closed."""

from functools import partial

import numpy as np
from jaxtyping import Float, Int

from sceneprior.core.errors import InputError
from sceneprior.evaluation.bootstrap import Estimate
from sceneprior.evaluation.metric import (
    AGAINST_TEST,
    GENERATED,
    PICTURED,
    Comparison,
    Metric,
    RoomSet,
    TableColumn,
)

FRECHET = {"inception": "fid", "effnet_lite0": "fd_effnet_lite0"}
"""Key of the Frechet distance for each feature network."""


def frechet_distance(
    a: Float[np.ndarray, "n dimensions"],
    b: Float[np.ndarray, "m dimensions"],
    counts_a: Int[np.ndarray, " n"] | None = None,
    counts_b: Int[np.ndarray, " m"] | None = None,
) -> float:
    """Frechet distance of the Gaussians fitted to two sets of features, in float64.

        d = |mean_a - mean_b|^2 + tr(S_a) + tr(S_b) - 2 tr((S_a S_b)^(1/2))

    with unbiased covariances. The last trace needs no matrix square root: with the centred features
    A and B divided by sqrt(n - 1), S_a = A^T A, S_b = B^T B, and the eigenvalues of S_a S_b are the
    squared singular values of A B^T. This stays exact with fewer images than dimensions, when both
    covariances are singular and the usual matrix square root returns rounding noise or complex
    numbers. It costs an SVD of a min(n, d) x min(m, d) matrix.

    Args:
        a, b: One feature vector per image; the sizes of the sets may differ.
        counts_a, counts_b: How often each row is in its set (see bootstrap.py); None: once.

    Returns:
        The squared distance, as FID reports it, never below 0. It falls with n even for samples of
        one distribution: compare only values computed with equal n.

    Source:
        Dowson and Landau, 1982; Heusel et al., "TTUR", NeurIPS 2017, for its use.

    Example: two sets whose means differ by 3 in one coordinate, with equal covariances.

        >>> points = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        >>> round(frechet_distance(points, points + np.array([3.0, 0.0])), 9)
        9.0
    """
    check_features(a, b)
    mean_a, root_a = _mean_and_root(a, counts_a)
    mean_b, root_b = _mean_and_root(b, counts_b)
    cross = np.linalg.svd(root_a @ root_b.T, compute_uv=False).sum()
    spread = (root_a**2).sum() + (root_b**2).sum()
    return max(float(((mean_a - mean_b) ** 2).sum() + spread - 2 * cross), 0.0)


def check_features(*sets: np.ndarray) -> None:
    """Raise InputError if a set of features (rows, dimensions) is too small or not finite."""
    for features in sets:
        if len(features) < 2:
            raise InputError(
                f"A Frechet distance needs at least 2 images in either set, but one set has "
                f"{len(features)}; synthesize or keep more rooms."
            )
        if not np.isfinite(features).all():
            raise InputError(
                "The features to compare hold numbers that are not finite; check the network "
                "file and the rendered images."
            )


def _mean_and_root(
    features: np.ndarray, counts: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """The mean, and a matrix R with R^T R = covariance and at most `dimensions` rows."""
    weights = np.ones(len(features)) if counts is None else counts.astype(np.float64)
    features, weights = features[weights > 0].astype(np.float64), weights[weights > 0]
    mean = weights @ features / weights.sum()
    root = np.sqrt(weights / (weights.sum() - 1))[:, None] * (features - mean)
    if root.shape[0] <= root.shape[1]:
        return mean, root
    return mean, np.asarray(np.linalg.qr(root, mode="r"))


def gap_closed(ours: float, independent: float, real: float) -> float:
    """Share of the gap between independent and real rooms that a Frechet distance closes.

        (independent - ours) / (independent - real)

    All three are distances to the test rooms, with equal numbers of rooms. 0: as far from the test
    rooms as rooms of independently drawn objects (`independent_rooms`); 1: as near as real training
    rooms. Values below 0 and above 1 occur. If independent rooms are as near as real ones, there is
    no gap, and the value is 1 if `ours <= real`, else 0.

    Example: a third of the way is left.

        >>> round(gap_closed(ours=50.0, independent=70.0, real=40.0), 3)
        0.667
    """
    if independent <= real:
        return float(ours <= real)
    return (independent - ours) / (independent - real)


def _distance(network: str, boxes: bool, rooms: RoomSet, comparison: Comparison) -> Estimate:
    a, b = rooms.features(network, boxes), comparison.test.features(network, boxes)
    counts = zip(rooms.counts, comparison.test.counts, strict=True)
    resamples = np.array([frechet_distance(a, b, *pair) for pair in counts])
    return Estimate(frechet_distance(a, b), resamples, 0.0)


def _gap(network: str, boxes: bool, rooms: RoomSet, comparison: Comparison) -> Estimate:
    key, known = FRECHET[network] + ("_boxes" if boxes else ""), comparison.columns
    furthest = "independent" if boxes else "independent_meshes"
    ours = _distance(network, boxes, rooms, comparison)
    distances = (ours, known[furthest][key], known["train_rooms"][key])
    value = gap_closed(*(distance.value or 0.0 for distance in distances))
    # Resamples repeat rooms, which raises all distances, so each distance's resamples are shifted
    # until their mean equals its value.
    moved = [
        (d.value or 0.0) + d.resamples - d.resamples.mean() for d in distances if len(d.resamples)
    ]
    return Estimate(value, np.array([gap_closed(*three) for three in zip(*moved, strict=True)]))


def _metrics_of(network: str, short: str, title: str, boxes_title: str) -> list[Metric]:
    """The four metrics of a network's features, in the order of tables."""
    lite = network == "effnet_lite0"
    key, gap = FRECHET[network], "gap_closed" if lite else f"gap_closed_{network}"
    ends = "0: independent, 1: as near as real"
    return [
        Metric(
            key, title, "", "closer",
            partial(_distance, network, False), PICTURED, network=network,
            column=TableColumn(
                "FD", 1, "FD: Frechet distance of EfficientNet-Lite0 features, which is not FID"
            ) if lite else TableColumn("FID", 1),
        ),
        Metric(
            f"{gap}_furnished", f"Gap closed, from independent furniture, {short}", ends, "higher",
            partial(_gap, network, False), GENERATED, network=network,
            protocol={
                "gap_closed": "(independent - generated) / (independent - real training), Frechet "
                "distances to the test rooms, n_pictured rooms each; 1 or 0 where independent <= "
                "real; _furnished: independent objects with their real meshes",
            },
            column=TableColumn(
                "gap closed", 2,
                "gap closed: share of the FD gap between independent objects with meshes and real "
                "training rooms that is closed",
            ) if lite else None,
        ),
        Metric(
            f"{key}_boxes", boxes_title, "", "closer",
            partial(_distance, network, True), AGAINST_TEST, network=network, boxes=True,
            protocol={
                "_boxes": "the same metric, all rooms drawn as boxes, real ones too (--boxes)"
            },
            column=TableColumn(
                "FD, boxes", 1,
                "boxes: the same, all rooms drawn as boxes, so that layouts alone count",
            ) if lite else None,
        ),
        Metric(
            f"{gap}_boxes", f"Gap closed, all rooms as boxes, {short}",
            "0: independent, 1: as near as real", "higher",
            partial(_gap, network, True), GENERATED, network=network, boxes=True,
            column=TableColumn("gap closed, boxes", 2) if lite else None,
        ),
    ]  # fmt: skip


METRICS = (
    *_metrics_of(
        "inception", "Inception", "FID (Inception)", "FID, all rooms as boxes (Inception)"
    ),
    *_metrics_of(
        "effnet_lite0",
        "Lite0",
        "Frechet distance, EfficientNet-Lite0 (not FID)",
        "Frechet distance, all rooms as boxes, Lite0 (not FID)",
    ),
)
