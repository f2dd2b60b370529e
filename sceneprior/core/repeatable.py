"""Repeatable results: the range of seeds, and torch on one thread."""

import contextlib
from collections.abc import Iterator

from sceneprior.core.errors import InputError

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
