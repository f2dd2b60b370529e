"""The vectorised exponential against numpy's."""

import numpy as np
import pytest
from numba import njit

from sceneprior.render.silhouettes.cpu.vector_exp import vector_exp


@pytest.mark.parametrize(("dtype", "ulps"), [(np.float32, 4), (np.float64, 1)])
def test_exp_is_exp(dtype, ulps):
    @njit
    def fill(x, y):
        for k in range(x.size):
            y[k] = vector_exp(x[k])

    x = np.linspace(-80, 80, 20_001).astype(dtype)
    y = np.empty_like(x)
    fill(x, y)
    # x itself is rounded in the reduction: its last place is worth |x| of the result's.
    error = np.abs(y / np.exp(x.astype(np.float64)) - 1)
    assert (error <= np.finfo(dtype).eps * (ulps + np.abs(x))).all()
    assert y[10_000] == 1
