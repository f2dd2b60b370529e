"""Lists and reads files that several data sets have: tables as text, and arrays in HDF5."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sceneprior.core.checked import plain
from sceneprior.core.errors import InputError

_MOST_VALUES = 64 << 20
"""Maximum number of values in an array; images and trajectories have far fewer."""


def by_number(paths: Sequence[Path]) -> list[Path]:
    """Sort paths that are named by numbers: 2 before 10."""
    return sorted(paths, key=lambda path: (len(path.name), path.name))


def read_table(path: Path, hint: str, **dialect: Any) -> list[list[str]]:
    """Rows of a text table, the header first; `hint` ends the message if it cannot be read.

    `dialect` holds options of `csv.reader`; the default is comma separated.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return list(csv.reader(file, **dialect))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path} cannot be read ({plain(str(error), 120)}); {hint}.") from None


def read_records(path: Path, hint: str) -> list[dict[str, str]]:
    """Rows of a comma separated table by the names in its header; short rows lack their ends."""
    header, *rows = read_table(path, hint) or [[]]
    return [dict(zip(header, row, strict=False)) for row in rows if row]


def read_hdf5(path: Path, names: Sequence[str], hint: str) -> list[np.ndarray]:
    """Read the arrays with these names; `hint` ends the message if one is missing or unusable."""
    import h5py  # here, because most data sets do not need it

    if not path.is_file():
        raise InputError(f"{path} is missing; {hint}.")
    try:
        with h5py.File(path, "r") as file:
            missing = [name for name in names if not isinstance(file.get(name), h5py.Dataset)]
            if missing:
                there = ", ".join(plain(str(name)) for name in list(file)[:8]) or "nothing"
                raise InputError(f"{path} has no '{missing[0]}' (it has {there}); {hint}.")
            for name in names:
                if file[name].size is None or file[name].size > _MOST_VALUES:
                    raise InputError(f"{path}: '{name}' has {file[name].size} values; {hint}.")
            return [np.asarray(file[name][()]) for name in names]
    except InputError:
        raise
    except Exception as error:  # the type that h5py raises depends on the damage
        reason = plain(" ".join(str(error).split()) or type(error).__name__, 120)
        raise InputError(f"{path} cannot be read ({reason}): it is damaged; {hint}.") from None
