"""Distances between two sets of pictures in a network's features: Frechet distance and the gap
closed, kernel distance (KID in Inception features), precision and recall."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.distance import cdist

from sceneprior.core.errors import InputError
from sceneprior.evaluation.metric import (
    AGAINST_TEST,
    COVERAGE,
    GENERATED,
    PICTURED,
    Comparison,
    Direction,
    Estimate,
    RoomSet,
    TableColumn,
    emptiness,
    mean_of_rooms,
    metric,
)

FRECHET = {"inception": "fid", "effnet_lite0": "fd_effnet_lite0"}
"""Key of the Frechet distance for each feature network."""
NEIGHBOUR = 3
"""k of the k-th nearest neighbour, whose distance is a ball's radius; 3 is the authors' setting. In
a set of 3 rows or fewer, the radius is the distance of the farthest row."""


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
        counts_a, counts_b: How often each row is in its set (see metric.py); None: once.

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
    no gap, and the value is undefined (NaN).

    Example: a third of the way is left.

        >>> round(gap_closed(ours=50.0, independent=70.0, real=40.0), 3)
        0.667
    """
    if independent <= real:
        return np.nan
    return (independent - ours) / (independent - real)


def _distance(suffix: str, network: str, rooms: RoomSet, comparison: Comparison) -> Estimate:
    a, b = (each.pictures[network + suffix] for each in (rooms, comparison.test))
    counts = zip(rooms.counts, comparison.test.counts, strict=True)
    return Estimate(np.array([frechet_distance(a, b, *pair) for pair in counts]), 0.0)


def _gap(suffix: str, network: str, rooms: RoomSet, comparison: Comparison) -> Estimate:
    key, known = FRECHET[network] + suffix, comparison.columns
    furthest = "independent" if suffix else "independent_meshes"
    ours = known["generated"][key]
    distances = [ours, known[furthest][key], known["train_rooms"][key]]
    values = np.array([distance.values for distance in distances])
    if len(rooms.counts) > 1:
        # Resamples repeat rooms, which raises all distances, so each distance's resamples are
        # shifted until their mean equals its value.
        values[:, 1:] += values[:, :1] - values[:, 1:].mean(axis=1, keepdims=True)
    found = Estimate(np.array([gap_closed(*three) for three in values.T.tolist()]))
    # A gap that is not measurable says nothing: the share of it is noise, such as -1010%.
    return found if np.isnan(found.values).mean() <= (1 - COVERAGE) / 2 else found.undefined


def kernel_distances(
    a: Float[np.ndarray, "n dimensions"],
    b: Float[np.ndarray, "m dimensions"],
    counts_a: Int[np.ndarray, "sets n"],
    counts_b: Int[np.ndarray, "sets m"],
) -> Float[np.ndarray, " sets"]:
    """Squared maximum mean discrepancy, unbiased, in float64, with the kernel of KID,
    k(x, y) = (x . y / dimensions + 1)^3.

    For two samples of one distribution its expectation is 0, whatever their sizes, and it may be
    negative. KID is often reported as the mean over random subsets. The mean over all subsets of a
    size equals the estimate on the whole sets, which is computed here and needs no seed.

    `counts_*` hold the multiplicity of each row, one line per set of rows.
    """
    check_features(a, b)
    a, b = a.astype(np.float64), b.astype(np.float64)
    aa, bb, ab = ((x @ y.T / x.shape[1] + 1) ** 3 for x, y in ((a, a), (b, b), (a, b)))

    def distances(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        n, m = u.sum(1), v.sum(1)
        within_a = ((u @ aa) * u).sum(1) - u @ aa.diagonal()
        within_b = ((v @ bb) * v).sum(1) - v @ bb.diagonal()
        between = ((u @ ab) * v).sum(1)
        return np.asarray(
            within_a / (n * (n - 1)) + within_b / (m * (m - 1)) - 2 * between / (n * m)
        )

    # The first alone, so that its last digits do not depend on how many sets follow.
    first, rest = (distances(counts_a[rows], counts_b[rows]) for rows in (slice(1), slice(1, None)))
    return np.concatenate([first, rest])


def _kernel_distance(network: str, rooms: RoomSet, comparison: Comparison) -> Estimate:
    features = rooms.pictures[network], comparison.test.pictures[network]
    return Estimate(kernel_distances(*features, rooms.counts, comparison.test.counts))


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
        return Estimate(np.full(len(rooms.counts), np.nan))
    inside = in_manifold(rooms.pictures[network], comparison.test.pictures[network])
    return mean_of_rooms(inside, rooms.counts, 1.0)


def _recall(network: str, rooms: RoomSet, comparison: Comparison) -> Estimate:
    test = comparison.test
    covered = in_manifold(test.pictures[network], rooms.pictures[network])
    return mean_of_rooms(covered, test.counts, 1.0)


_COLUMNS = {
    "fid": TableColumn("FID", 1),
    "fd_effnet_lite0": TableColumn(
        "FD", 1, "FD: Frechet distance of EfficientNet-Lite0 features, which is not FID"
    ),
    "gap_closed_furnished": TableColumn(
        "gap closed", 2,
        "gap closed: share of the FD gap between independent objects with meshes and real training "
        "rooms that is closed",
    ),
    "fd_effnet_lite0_boxes": TableColumn(
        "FD, boxes", 1, "boxes: the same, all rooms drawn as boxes, so that layouts alone count"
    ),
    "gap_closed_boxes": TableColumn("gap closed, boxes", 2),
    "recall_effnet_lite0": TableColumn(
        "recall", 2, "recall: share of test rooms that lie among the pictures of the row"
    ),
}  # fmt: skip
_PROTOCOL = {
    "gap_closed_furnished": {
        "gap_closed": "(independent - generated) / (independent - real training), Frechet "
        "distances to the test rooms, n_pictured rooms each; undefined if independent <= real in "
        f"more than {(1 - COVERAGE) / 2:.1%} of the resamples; _furnished: independent objects "
        "with their real meshes",
    },
    "fd_effnet_lite0_boxes": {
        "_boxes": "the same metric, all rooms drawn as boxes, real ones too (--boxes)"
    },
    "kid_effnet_lite0": {"kid": "unbiased, kernel (x . y / dimensions + 1)^3, over the whole sets"},
    "precision_effnet_lite0": {"precision_recall_k": NEIGHBOUR},
}


_ENDS = "0: independent, 1: as near as real"
for _network, _gap_key, _kid, _titles in (
    ("inception", "gap_closed_inception", "kid", (
        "FID (Inception)", "Gap closed, from independent furniture, Inception",
        "FID, all rooms as boxes (Inception)", "Gap closed, all rooms as boxes, Inception",
        "KID (Inception)", "Precision, Inception", "Recall, Inception",
    )),
    ("effnet_lite0", "gap_closed", "kid_effnet_lite0", (
        "Frechet distance, EfficientNet-Lite0 (not FID)",
        "Gap closed, from independent furniture, Lite0",
        "Frechet distance, all rooms as boxes, Lite0 (not FID)",
        "Gap closed, all rooms as boxes, Lite0",
        "Kernel distance, EfficientNet-Lite0 (not KID)", "Precision, EfficientNet-Lite0",
        "Recall, EfficientNet-Lite0",
    )),
):  # fmt: skip
    _metrics: tuple[tuple[str, str, Direction, tuple[str, ...], Callable[..., Any]], ...] = (
        (FRECHET[_network], "", "closer", PICTURED, partial(_distance, "")),
        (f"{_gap_key}_furnished", _ENDS, "higher", GENERATED, partial(_gap, "")),
        (f"{FRECHET[_network]}_boxes", "", "closer", AGAINST_TEST, partial(_distance, "_boxes")),
        (f"{_gap_key}_boxes", _ENDS, "higher", GENERATED, partial(_gap, "_boxes")),
        (_kid, "", "closer", PICTURED, _kernel_distance),
        (f"precision_{_network}", "share of rooms", "higher", PICTURED, _precision),
        (f"recall_{_network}", "share of test rooms", "higher", PICTURED, _recall),
    )
    for _title, (_key, _unit, _better, _sets, _function) in zip(_titles, _metrics, strict=True):
        metric(
            _key, _title, _unit, _better, _sets, _network,
            protocol=_PROTOCOL.get(_key, {}), column=_COLUMNS.get(_key),
        )(partial(_function, _network))  # fmt: skip


@metric(
    "recall_ratio", "Recall over that of real training rooms", "1: as varied as real", "higher",
    GENERATED, "effnet_lite0",
)  # fmt: skip
def _recall_ratio(rooms: RoomSet, comparison: Comparison) -> Estimate:
    real = comparison.columns["train_rooms"]["recall_effnet_lite0"]
    ours = comparison.columns["generated"]["recall_effnet_lite0"]
    return ours.combined(real, np.divide, low=0.0)
