"""Models are as large as real furniture."""

from statistics import median

import pytest

from sceneprior.furniture.catalog import at_score, make_catalog, real_sizes


def test_sizes_keep_to_the_real_percentiles():
    for name, models in make_catalog(0, "front3d_bedroom").items():
        for axis, (low, middle, high) in enumerate(real_sizes()[name]):
            sizes = [model.size_m[axis] for model in models]
            # An even dozen has no model at the median itself: the middle two straddle it.
            assert median(sizes) == pytest.approx(middle, rel=0.15), (name, axis)
            assert low < median(sizes) < high
            assert sum(low <= size <= high for size in sizes) >= 10
    at_ends = [at_score(1.0, 2.0, 6.0, score) for score in (-1.2816, 0.0, 1.2816)]
    assert at_ends == pytest.approx([1, 2, 6])
