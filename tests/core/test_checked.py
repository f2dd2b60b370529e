"""Values out of files: numbers are numbers, and messages stay short whatever they show."""

from typing import Any

import numpy as np
import pytest

from sceneprior.core.checked import number_array, shown


@pytest.mark.parametrize("value", [[1, "2"], [None], "1", [10**400], {"a": 1}])
def test_what_holds_no_numbers(value):
    with pytest.raises(TypeError, match="not all are numbers"):
        number_array(value)
    np.testing.assert_array_equal(number_array([[1, 2.5]]), [[1, 2.5]])
    with pytest.raises(ValueError, match="inhomogeneous"):
        number_array([[1], [2, 3]])


def test_deep_and_long_values_are_shown_short():
    deep: Any = 0
    for _ in range(5000):
        deep = [deep]
    for value in (deep, {"\ud800": deep}, ["x" * 9999] * 9999, 10**9999, float("nan")):
        assert len(shown(value)) <= 62 and shown(value).isprintable()
