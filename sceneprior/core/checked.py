"""Validates what is read from files: plain data against models, and arrays in caches."""

import contextlib
import hashlib
import io
import reprlib
import warnings
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel, ValidationError

from sceneprior.core.errors import InputError, InputWarning
from sceneprior.core.files import read_arrays, write_whole

_M = TypeVar("_M", bound=BaseModel)
_LONGEST = 60


class _Repr(reprlib.Repr):
    """Short representations, also of integers that Python does not convert to text."""

    def repr_int(self, x: int, level: int) -> str:
        return "a number of many digits" if abs(x) >= 10**_LONGEST else super().repr_int(x, level)


_REPR = _Repr()
_REPR.maxstring = _LONGEST


def checked(model: type[_M], data: Any, where: str, hint: str = "") -> _M:
    """Validate parsed JSON against a Pydantic model; `hint` says what to do if it is another."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        if first["type"] == "value_error":
            raise InputError(f"{where}: {first['ctx']['error']}") from None
        raise InputError(f"{where}: {fault_of(error)}{'; ' if hint else ''}{hint}.") from None


def fault_of(error: ValidationError) -> str:
    """Describe the first fault: the key, its value, and what was expected."""
    first = error.errors(include_url=False)[0]
    key, reason = plain(".".join(map(str, first["loc"])), 200) or "it", first["msg"]
    if first["type"] == "missing":  # its input is the whole object without the key
        return f"{key} is missing"
    if first["type"] == "model_type":  # Pydantic's message names our class
        reason = "expected a JSON object"
    return f"{key} is {shown(first['input'])}; {reason[:1].lower()}{reason[1:]}"


def keep_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write arrays to a cache, an .npz with their digest, from which `kept_arrays` reads them."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, sha256=np.array(_digest(arrays)), **arrays)
    write_whole(path, buffer.getvalue())


def kept_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of `keep_arrays`; none if the file is missing, or other than it was written,
    which a warning says."""
    if not path.is_file():
        return {}
    with contextlib.suppress(InputError):
        arrays = read_arrays(path)
        if str(arrays.pop("sha256", "")) == _digest(arrays):
            return arrays
    warnings.warn(
        f"{path} is damaged, or of an earlier release; it is made again.",
        InputWarning,
        stacklevel=2,
    )
    return {}


def _digest(arrays: dict[str, np.ndarray]) -> str:
    summary = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        summary.update(f"{name} {array.dtype} {array.shape}".encode())
        summary.update(array.tobytes())
    return summary.hexdigest()


def number_array(value: Any) -> np.ndarray:
    """Convert nested lists of numbers to float64.

    Raises:
        TypeError: an entry is a string, null or too large a number.
        ValueError: rows have different lengths.
    """
    array = np.array(value)
    if array.dtype.kind not in "iuf":
        raise TypeError("not all are numbers")
    return array.astype(np.float64)


def shown(value: Any) -> str:
    """Format a value from a file for a message: short and printable, whatever its depth or length.

    >>> shown({"a": [1, 2]}), len(shown("x" * 10_000)), shown(10**5000)
    ("{'a': [1, 2]}", 62, 'a number of many digits')
    """
    return f"'{plain(value)}'" if isinstance(value, str) else plain(_REPR.repr(value))


def plain(text: str, longest: int = _LONGEST) -> str:
    """Escape a text from a file if it is not printable, and shorten it if it is long.

    >>> plain("Büro"), plain("a" + chr(10)), plain("x" * 99, longest=5)
    ('Büro', 'a\\\\n', 'xx...')
    """
    text = text[: 2 * longest]
    text = text if text.isprintable() else ascii(text)[1:-1]
    return text if len(text) <= longest else f"{text[: longest - 3]}..."
