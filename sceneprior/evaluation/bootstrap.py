"""How far a figure would move with other rooms: figures with their resamples in, intervals out."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Real

RESAMPLES = 200
COVERAGE = 0.95
METHOD = (
    f"{COVERAGE:.0%} bootstrap over rooms, both sets drawn anew with replacement; quantiles moved "
    "so that the resamples' mean meets the figure"
)


def resample_counts(
    rooms: int, resamples: int, seed: int | tuple[int, ...]
) -> Int[np.ndarray, "resamples rooms"]:
    """How often each room is drawn when `rooms` are drawn with replacement, a line a resample."""
    shares = np.full(rooms, 1 / rooms)
    return np.random.default_rng(seed).multinomial(rooms, shares, size=resamples)


@dataclass(frozen=True)
class Figure:
    """A number, and the same number of every resample."""

    value: float | None
    """None where the figure does not exist."""
    draws: Float[np.ndarray, " resamples"]
    """Resamples in which the figure does not exist are left out."""
    low: float = -np.inf
    high: float = np.inf
    """The range in which the figure lies by definition."""

    def interval(self) -> list[float] | None:
        """[lower, upper] end; None without a figure or without resamples.

        Drawing with replacement repeats rooms, and two sets of fewer different rooms lie farther
        apart: the resamples of a Frechet distance all lie above the distance itself. Their spread
        is what counts; so the quantiles are taken around the resamples' own mean.
        """
        if self.value is None or len(self.draws) == 0:
            return None
        tail = (1 - COVERAGE) / 2
        ends = self.value + np.quantile(self.draws, [tail, 1 - tail]) - self.draws.mean()
        return [float(end) for end in np.clip(ends, self.low, self.high)]


def ratio(
    numerators: Real[np.ndarray, " rooms"],
    denominators: Real[np.ndarray, " rooms"],
    counts: Int[np.ndarray, "resamples rooms"],
    high: float = np.inf,
) -> Figure:
    """A sum over rooms divided by another: a mean over rooms, or over what they hold.

    Args:
        numerators: What each room adds.
        denominators: What each room weighs; 0 leaves a room out. If all are 0 there is no figure.
        counts: From `resample_counts`.
        high: The largest value it can have; the smallest is 0.
    """
    total = denominators.sum()
    value = float(numerators.sum() / total) if total > 0 else None
    over = counts @ denominators
    draws = (counts @ numerators)[over > 0] / over[over > 0]
    return Figure(value, draws, 0.0, high)
