"""Kernel distance (KID in Inception features): maximum mean discrepancy of two sets of pictures."""

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sceneprior.evaluation.bootstrap import Estimate
from sceneprior.evaluation.metric import PICTURED, Comparison, Metric, RoomSet
from sceneprior.evaluation.metrics.frechet import check_features


class Kernels(NamedTuple):
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
    """Squared maximum mean discrepancy, unbiased, in float64.

    It is around 0, and may be below, for two samples of one distribution, whatever their sizes.
    KID is often stated as the mean over random subsets; the mean over ALL subsets, of any size,
    is the estimate on the whole sets, which is computed here: it needs no seed.

    `counts_*` say how often each row is in its set, a line per resample; None: once, one line.
    """
    counts_a = np.ones((1, len(of.aa)), int) if counts_a is None else counts_a
    counts_b = np.ones((1, len(of.bb)), int) if counts_b is None else counts_b
    n, m = counts_a.sum(1), counts_b.sum(1)
    within_a = ((counts_a @ of.aa) * counts_a).sum(1) - counts_a @ of.aa.diagonal()
    within_b = ((counts_b @ of.bb) * counts_b).sum(1) - counts_b @ of.bb.diagonal()
    between = ((counts_a @ of.ab) * counts_b).sum(1)
    return np.asarray(within_a / (n * (n - 1)) + within_b / (m * (m - 1)) - 2 * between / (n * m))


def _estimate(network: str, rooms: RoomSet, comparison: Comparison) -> Estimate:
    test = comparison.test
    pairs = kernels(rooms.features(network), test.features(network))
    resamples = kernel_distance(pairs, rooms.counts, test.counts)
    return Estimate(float(kernel_distance(pairs)[0]), resamples)


METRICS = tuple(
    Metric(
        key, title, "", "closer", definition, partial(_estimate, network), PICTURED,
        network=network, source="Binkowski et al., ICLR 2018",
        protocol={"kid": "unbiased, kernel (x . y / dimensions + 1)^3, over the whole sets"},
    )
    for network, key, title, definition in (
        ("inception", "kid", "KID (Inception)", "`kid_effnet_lite0` in Inception features."),
        (
            "effnet_lite0", "kid_effnet_lite0", "Kernel distance, EfficientNet-Lite0 (not KID)",
            "Squared maximum mean discrepancy, unbiased, kernel `(x . y / dimensions + 1)^3`: "
            "around 0, perhaps below, for two samples of one distribution of any sizes; computed "
            "on the whole sets, which is the mean over all subsets, and not times 1,000.",
        ),
    )
)  # fmt: skip
