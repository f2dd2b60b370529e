"""Keeps jaxtyping's hook from wrapping what Numba and Triton compile: they compile no wrapper.

`conftest.py` and `test_cuda.py` import this before any module of ours.
"""

import ast

from jaxtyping import _import_hook

_says_no_type_check = _import_hook._is_no_type_check


def _is_left_alone(decorator: ast.AST) -> bool:
    called = ast.unparse(decorator).partition("(")[0]
    return called in ("njit", "triton.jit") or _says_no_type_check(decorator)


_import_hook._is_no_type_check = _is_left_alone
