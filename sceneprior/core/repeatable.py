"""Repeatable results: the range of seeds, and torch on one thread; and constants on a device."""

import contextlib
from collections.abc import Iterator
from functools import cache
from typing import TYPE_CHECKING, Any

from sceneprior.core.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor as Tensor
else:
    Tensor = Any  # torch is imported late; shapes are checked all the same

LARGEST_SEED = 2**32 - 1
"""Largest seed that NumPy, PyTorch, scikit-learn and Lightning all accept."""


def check_seed(seed: int) -> None:
    """Check that a seed is in the valid range."""
    if not 0 <= seed <= LARGEST_SEED:
        raise InputError(f"The seed is {seed}; expected a whole number from 0 to {LARGEST_SEED}.")


@contextlib.contextmanager
def single_threaded() -> Iterator[None]:
    """Limit torch to one thread, so that results are bit-identical on any number of cores.

    To use several cores, call functions from several threads inside one `with single_threaded()`.
    """
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def constants(like: Tensor, *values: float | int) -> Tensor:
    """The values as a tensor of the type and device of `like`, which must not be modified.

    It is copied to the device once. `like.new_tensor` copies it every time, for which a GPU is
    waited for, and cannot be used in CUDA graphs.
    """
    return _constants(values, like.dtype, like.device)


@cache
def _constants(values: tuple[float | int, ...], dtype: Any, device: Any) -> Tensor:
    import torch

    with torch.inference_mode(False):  # gradients may pass through it later
        return torch.tensor(values, dtype=dtype, device=device)
