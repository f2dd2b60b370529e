"""Estimates with bootstrap intervals: the variation of a metric over the choice of rooms."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Real, Shaped

RESAMPLES = 200
COVERAGE = 0.95
METHOD = (
    f"{COVERAGE:.0%} bootstrap over rooms, both sets resampled with replacement; quantiles shifted "
    "so that the mean of the resamples equals the metric's value"
)


def resample_counts(
    rooms: int, resamples: int, seed: int | tuple[int, ...]
) -> Int[np.ndarray, "resamples rooms"]:
    """Count how often each room occurs in each resample of `rooms` drawn with replacement."""
    shares = np.full(rooms, 1 / rooms)
    return np.random.default_rng(seed).multinomial(rooms, shares, size=resamples)


@dataclass(frozen=True)
class Estimate:
    """A metric's value on the rooms and on every resample of them."""

    value: float | None
    """Value on the rooms themselves; None if the metric is undefined for this set."""
    resamples: Float[np.ndarray, " resamples"]
    """Values on the resamples; those on which the metric is undefined are left out."""
    low: float = -np.inf
    high: float = np.inf
    """Bounds of the metric by definition; the interval is clipped to [low, high]."""

    def interval(self) -> list[float] | None:
        """Lower and upper end of the interval; None if there is no value or there are no resamples.

        Drawing with replacement repeats rooms, and sets with fewer distinct rooms lie farther
        apart: the resamples of a Frechet distance all lie above the distance itself. This bias is
        removed: the quantiles are shifted so that the mean of the resamples equals the value.
        """
        if self.value is None or len(self.resamples) == 0:
            return None
        tail = (1 - COVERAGE) / 2
        spread = np.quantile(self.resamples, [tail, 1 - tail])
        ends = self.value + spread - self.resamples.mean()
        return [float(end) for end in np.clip(ends, self.low, self.high)]

    def over(self, other: "Estimate") -> "Estimate":
        """The ratio of this metric to another, both at least 0; undefined if the other is 0."""
        if self.value is None or not other.value:
            return Estimate(None, np.zeros(0))
        ours, theirs = _paired(self, other)
        known = theirs != 0
        return Estimate(self.value / other.value, ours[known] / theirs[known], 0.0)

    def minus(self, other: "Estimate") -> "Estimate":
        """This metric minus another; undefined if either metric is undefined."""
        if self.value is None or other.value is None:
            return Estimate(None, np.zeros(0))
        ours, theirs = _paired(self, other)
        return Estimate(self.value - other.value, ours - theirs)

    def mean_with(self, other: "Estimate") -> "Estimate":
        """The mean of two shares, from 0 to 1; undefined if either share is undefined."""
        if self.value is None or other.value is None:
            return Estimate(None, np.zeros(0))
        ours, theirs = _paired(self, other)
        return Estimate((self.value + other.value) / 2, (ours + theirs) / 2, 0.0, 1.0)


def _paired(a: Estimate, b: Estimate) -> tuple[np.ndarray, np.ndarray]:
    """The resamples of both estimates, cut to the length of the shorter list."""
    both = min(len(a.resamples), len(b.resamples))
    return a.resamples[:both], b.resamples[:both]


def ratio(
    numerators: Real[np.ndarray, " rooms"],
    denominators: Real[np.ndarray, " rooms"],
    counts: Int[np.ndarray, "resamples rooms"],
    high: float = np.inf,
) -> Estimate:
    """The ratio of two sums over rooms, from 0 to `high`, such as a mean over rooms or objects.

    A denominator of 0 leaves its room out. If all are 0, the value is None.
    """
    total = denominators.sum()
    value = float(numerators.sum() / total) if total > 0 else None
    over = counts @ denominators
    return Estimate(value, (counts @ numerators)[over > 0] / over[over > 0], 0.0, high)


def mean_of_rooms(
    values: Sequence[float | int | None] | Shaped[np.ndarray, " rooms"],
    counts: Int[np.ndarray, "resamples rooms"],
    high: float = np.inf,
) -> Estimate:
    """The mean over rooms of non-negative values; rooms with None are left out."""
    known = np.array([value is not None for value in values], dtype=float)
    return ratio(np.array([value or 0.0 for value in values], dtype=float), known, counts, high)
