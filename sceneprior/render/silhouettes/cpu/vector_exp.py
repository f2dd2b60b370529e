"""A vectorisable exp for compiled loops over pixels."""

from typing import no_type_check

import numpy as np
from numba import types
from numba.extending import intrinsic, overload


@intrinsic
def _float_of_bits(_context, _bits):
    def build(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], context.get_value_type(types.float32))

    return types.float32(types.int32), build


@no_type_check
def vector_exp(x):
    """e**x for -80 <= x <= 80, in the precision of x; `_compiled` replaces it in Numba code."""
    return np.exp(x)


@overload(vector_exp, inline="always")
@no_type_check
def _compiled(x):
    if x != types.float32:
        return lambda x: np.exp(x)

    def exp32(x):
        # A library call would prevent vectorisation, so e**x = 2**n * e**f with |f| <= ln(2) / 2;
        # the series to f**6 is within 2 units in the last place.
        n = np.int32(np.floor(x * np.float32(1.4426950408889634) + np.float32(0.5)))
        f = x - np.float32(n) * np.float32(0.6931471805599453)
        series = np.float32(1 / 720)
        series = series * f + np.float32(1 / 120)
        series = series * f + np.float32(1 / 24)
        series = series * f + np.float32(1 / 6)
        series = series * f + np.float32(1 / 2)
        series = series * f + np.float32(1)
        series = series * f + np.float32(1)
        return series * _float_of_bits(np.int32((n + np.int32(127)) << np.int32(23)))

    return exp32
