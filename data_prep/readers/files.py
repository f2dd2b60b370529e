"""Reads arrays from other programs' HDF5 files, and reports any fault in one sentence."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sceneprior.core.checked import plain
from sceneprior.core.errors import InputError

_MOST_VALUES = 64 << 20
"""Maximum number of values in an array; images and trajectories have far fewer."""


def read_hdf5(path: Path, names: Sequence[str], hint: str) -> list[np.ndarray]:
    """Read the arrays with these names; `hint` ends the message if one is missing or unusable."""
    import h5py  # here, because the other sources do not need it

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
