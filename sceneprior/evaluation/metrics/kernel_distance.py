"""Kernel distance (KID in Inception features): maximum mean discrepancy of two sets of pictures.

Source: Binkowski et al., ICLR 2018.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sceneprior.evaluation.bootstrap import Estimate
from sceneprior.evaluation.metric import PICTURED, Comparison, Metric, RoomSet
from sceneprior.evaluation.metrics.frechet import check_features


class Kernels(NamedTuple):
    """Kernel matrices within and between two sets, computed once for all resamples."""

    aa: np.ndarray
    bb: np.ndarray
    ab: np.ndarray


def kernels(a: Float[np.ndarray, "n dimensions"], b: Float[np.ndarray, "m dimensions"]) -> Kernels:
    """Values of KID's kernel, k(x, y) = (x . y / dimensions + 1)^3, for all pairs of rows."""
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

    For two samples of one distribution its expectation is 0, whatever their sizes, and it may be
    negative. KID is often reported as the mean over random subsets. The mean over all subsets of a
    size equals the estimate on the whole sets, which is computed here and needs no seed.

    `counts_*` hold the multiplicity of each row, one line per resample; None: each row once.
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
        key, title, "", "closer", partial(_estimate, network), PICTURED, network=network,
        protocol={"kid": "unbiased, kernel (x . y / dimensions + 1)^3, over the whole sets"},
    )
    for network, key, title in (
        ("inception", "kid", "KID (Inception)"),
        ("effnet_lite0", "kid_effnet_lite0", "Kernel distance, EfficientNet-Lite0 (not KID)"),
    )
)  # fmt: skip
