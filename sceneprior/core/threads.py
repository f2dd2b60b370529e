"""Limits torch to one thread, for results that do not depend on the number of cores."""

import contextlib
from collections.abc import Iterator

import torch


@contextlib.contextmanager
def single_threaded() -> Iterator[None]:
    """Limit torch to one thread, so that results are bit-identical on any number of cores.

    To use several cores, call functions from several threads inside one `with single_threaded()`.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
