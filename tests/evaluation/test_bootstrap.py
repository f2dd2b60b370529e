"""Intervals: that they cover what they claim, and sit where the estimate is."""

import numpy as np
import pytest

from sceneprior.evaluation.metric import COVERAGE, Estimate, ratio, resample_counts
from sceneprior.evaluation.metrics.picture_distances import frechet_distance


def test_the_interval_of_a_mean_covers_it_as_often_as_it_says(rng):
    covered = 0
    for trial in range(300):
        sample = rng.exponential(size=60)
        low, high = ratio(sample, np.ones(60), resample_counts(60, 200, trial)).interval()
        assert low < sample.mean() < high
        covered += low <= 1 <= high
    # 95% of 300, give or take three standard deviations; skewed samples of 60 lose 2%.
    assert 0.89 < covered / 300 < 0.99 and COVERAGE == 0.95


def test_the_interval_of_a_distance_holds_the_distance_though_no_resample_does(rng):
    a, b = rng.normal(size=(30, 50)), rng.normal(size=(30, 50))
    counts = zip(resample_counts(30, 60, 1), resample_counts(30, 60, 2), strict=True)
    estimate = Estimate(np.array([frechet_distance(a, b, x, y) for x, y in counts]), 0.0)
    assert estimate.value == frechet_distance(a, b)
    assert estimate.values[1:].min() > estimate.value  # repeated rooms: fewer different ones
    low, high = estimate.interval()
    assert low < estimate.value < high
    spread = np.quantile(estimate.values[1:], [0.025, 0.975])
    assert high - low == pytest.approx(np.diff(spread)[0])


def test_ratios_leave_out_what_weighs_nothing_and_stay_in_their_range():
    counts = np.array([[1, 1, 1], [2, 0, 0], [0, 0, 2], [1, 1, 0]])
    estimate = ratio(np.array([1.0, 0.0, 0.0]), np.array([1.0, 1.0, 0.0]), counts, 1.0)
    np.testing.assert_equal(estimate.values, [0.5, 1.0, np.nan, 0.5])
    assert estimate.interval() == pytest.approx([0.2625, 0.7375])
    assert Estimate(np.array([0.9, 0.0, 1.0]), 0.0, 1.0).interval() == pytest.approx([0.425, 1.0])
