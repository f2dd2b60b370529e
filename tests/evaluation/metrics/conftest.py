"""Two sets of features, and small rooms whose metrics are known by hand."""

import numpy as np
import pytest


@pytest.fixture
def two_sets(rng) -> tuple[np.ndarray, np.ndarray]:
    turn = rng.normal(size=(12, 12))
    return rng.normal(size=(40, 12)) @ turn, rng.normal(size=(30, 12)) @ turn + 0.5
