"""Compare two sets of pictures by their features: arrays in, distances and memberships out.

Everything in float64. `counts` say how often each row is in its set: 1 by default, the
multiplicities of a resample in bootstrap.py.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.distance import cdist

from sceneprior.errors import InputError

NEIGHBOUR = 3
"""Improved precision and recall: a row's neighbourhood reaches to this nearest other row, as in the
authors' settings; in a set of 3 or fewer to the farthest one."""


def frechet_distance(
    a: Float[np.ndarray, "n dimensions"],
    b: Float[np.ndarray, "m dimensions"],
    counts_a: Int[np.ndarray, " n"] | None = None,
    counts_b: Int[np.ndarray, " m"] | None = None,
) -> float:
    """Frechet distance of the Gaussians fitted to two sets of features, in float64.

        d = |mean_a - mean_b|^2 + tr(S_a) + tr(S_b) - 2 tr((S_a S_b)^(1/2))

    with covariances over n - 1. The last trace needs no matrix square root: with the centred
    features A and B divided by sqrt(n - 1), S_a = A^T A, S_b = B^T B, and the eigenvalues of
    S_a S_b are the squared singular values of A B^T. That is exact also where there are fewer
    images than dimensions and both covariances are singular, which the usual square root
    answers with rounding noise or complex numbers. It costs an SVD of min(n, d) x min(m, d).

    Args:
        a: One feature vector per image.
        b: The other set; the sizes may differ.
        counts_a: How often each row of `a` is in its set; None: once.
        counts_b: The same of `b`.

    Returns:
        The squared distance (what "FID" reports), never below 0. It falls with n even for one
        and the same distribution: compare only figures made with equal n.

    Raises:
        InputError: a set holds fewer than two rows, or numbers that are not finite.

    Source:
        Dowson and Landau, 1982; Heusel et al., "TTUR", NeurIPS 2017, for its use.

    Example: two features that differ by 3 in one coordinate and not in spread.

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


def gap_closed(ours: float, independent: float, real: float) -> float:
    """How much of the way from independent rooms to real ones a Frechet distance has gone.

        (independent - ours) / (independent - real)

    0: no nearer to the test rooms than rooms whose objects know nothing of each other; 1: as near
    as real rooms. Below 0 and above 1 exist. Where independent rooms are as near as real ones,
    there is no way to go, and it is 1 for `ours` no farther than real rooms, else 0.

    Args:
        ours: Distance of the judged rooms to the test rooms.
        independent: The same of rooms from `independent_rooms`.
        real: The same of real training rooms. All three with equal numbers of rooms.

    Example: a third of the way is left.

        >>> round(gap_closed(ours=50.0, independent=70.0, real=40.0), 3)
        0.667
    """
    if independent <= real:
        return float(ours <= real)
    return (independent - ours) / (independent - real)


def check_features(*sets: np.ndarray) -> None:
    """Refuse what no distance exists for; sets are (rows, dimensions) each.

    Raises:
        InputError: a set holds fewer than two rows, or numbers that are not finite.
    """
    for features in sets:
        if len(features) < 2:
            raise InputError(
                f"A Frechet distance needs at least 2 images on either side, but {len(features)} "
                "came; synthesize or keep more rooms."
            )
        if not np.isfinite(features).all():
            raise InputError(
                "The features to compare hold numbers that are not finite; check the network "
                "file and the rendered images."
            )


def _mean_and_root(
    features: np.ndarray, counts: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """The mean, and R with R^T R = covariance and at most `dimensions` rows."""
    weights = np.ones(len(features)) if counts is None else counts.astype(np.float64)
    features, weights = features[weights > 0].astype(np.float64), weights[weights > 0]
    mean = weights @ features / weights.sum()
    root = np.sqrt(weights / (weights.sum() - 1))[:, None] * (features - mean)
    if root.shape[0] <= root.shape[1]:
        return mean, root
    return mean, np.asarray(np.linalg.qr(root, mode="r"))


@dataclass(frozen=True)
class Kernels:
    """Kernel values within and between two sets, made once for any number of resamples."""

    aa: np.ndarray
    bb: np.ndarray
    ab: np.ndarray


def kernels(a: Float[np.ndarray, "n dimensions"], b: Float[np.ndarray, "m dimensions"]) -> Kernels:
    """k(x, y) = (x . y / dimensions + 1)^3 of all pairs: the kernel that KID is defined with."""
    check_features(a, b)
    a, b = a.astype(np.float64), b.astype(np.float64)

    def kernel(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return (x @ y.T / x.shape[1] + 1) ** 3

    return Kernels(kernel(a, a), kernel(b, b), kernel(a, b))


def kernel_distance(
    of: Kernels,
    counts_a: Int[np.ndarray, "resamples n"] | None = None,
    counts_b: Int[np.ndarray, "resamples m"] | None = None,
) -> Float[np.ndarray, " resamples"]:
    """Squared maximum mean discrepancy, unbiased: the kernel distance (KID in Inception features).

    It is around 0, and may be below, for two samples of one distribution, whatever their sizes.
    KID is often stated as the mean over random subsets; the mean over ALL subsets, of any size,
    is the estimate on the whole sets, which is computed here: it needs no seed.

    Args:
        of: From `kernels`.
        counts_a: How often each row is in its set, a line per resample; None: once, one line.
        counts_b: The same of the other set.

    Source:
        Binkowski et al., "Demystifying MMD GANs", ICLR 2018.
    """
    counts_a = np.ones((1, len(of.aa)), int) if counts_a is None else counts_a
    counts_b = np.ones((1, len(of.bb)), int) if counts_b is None else counts_b
    n, m = counts_a.sum(1), counts_b.sum(1)
    within_a = ((counts_a @ of.aa) * counts_a).sum(1) - counts_a @ of.aa.diagonal()
    within_b = ((counts_b @ of.bb) * counts_b).sum(1) - counts_b @ of.bb.diagonal()
    between = ((counts_a @ of.ab) * counts_b).sum(1)
    return np.asarray(within_a / (n * (n - 1)) + within_b / (m * (m - 1)) - 2 * between / (n * m))


def precision_recall(
    generated: Float[np.ndarray, "n dimensions"],
    real: Float[np.ndarray, "m dimensions"],
    neighbour: int = NEIGHBOUR,
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " m"]]:
    """Improved precision and recall, room by room.

    A set's manifold is the union of balls around its rows, each reaching to the row's
    `neighbour`-th nearest other row of the same set. The border belongs to it, so equal pictures,
    whose balls have no radius, lie in each other's.

    Returns:
        Which generated rows lie in the real manifold, whose mean is precision, and which real
        rows lie in the generated one, whose mean is recall.

    Source:
        Kynkaanniemi et al., "Improved Precision and Recall Metric", NeurIPS 2019.
    """
    check_features(generated, real)
    between = cdist(generated.astype(np.float64), real.astype(np.float64))
    return (
        (between <= _radii(real, neighbour)[None]).any(1),
        (between <= _radii(generated, neighbour)[:, None]).any(0),
    )


def _radii(features: np.ndarray, neighbour: int) -> np.ndarray:
    features = features.astype(np.float64)
    # Column 0 of the sorted distances is the row itself.
    rank = min(neighbour, len(features) - 1)
    return np.asarray(np.partition(cdist(features, features), rank, axis=1)[:, rank])
