"""Work for several threads: every item once, errors told, whatever the number of threads."""

import threading

import numba
import numpy as np
import pytest

from sceneprior.silhouettes.cpu.threads import in_threads


@pytest.mark.parametrize("items", [0, 1, 2, 5, 6, 7, 100])
def test_every_item_is_done_once(items):
    times = np.zeros(items, dtype=int)

    def count(first: int, last: int, times: np.ndarray, by: int) -> None:
        times[first:last] += by

    in_threads(count, items, times, 2)
    assert (times == 2).all()


def test_one_thread_stays_in_the_callers():
    before = numba.get_num_threads()
    names = []
    try:
        numba.set_num_threads(1)
        in_threads(lambda first, last: names.append(threading.current_thread().name), 9)
    finally:
        numba.set_num_threads(before)
    assert names == [threading.current_thread().name]


def test_an_error_in_a_thread_is_the_callers():
    def refuse(first: int, last: int) -> None:
        raise ValueError(f"items {first} to {last}")

    with pytest.raises(ValueError, match="items 0 to"):
        in_threads(refuse, 20)
