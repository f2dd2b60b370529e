"""Work for several threads: every item once, errors told, whatever the number of threads."""

import os
import subprocess
import sys

import pytest

from sceneprior.render.silhouettes.cpu.threads import in_threads


def test_torch_keeps_its_number_of_threads():
    # In a process of its own: Numba starts its pool, which sets torch's threads, once in each.
    code = """
import numba, torch
from sceneprior.render.silhouettes.cpu.threads import in_threads
torch.set_num_threads(1)
torch.get_num_threads()  # only now, or by a large sum, does torch ask OpenMP for them
in_threads(lambda first, last: None, 9)
print(torch.get_num_threads())
"""
    threads = {"NUMBA_NUM_THREADS": "2", "NUMBA_THREADING_LAYER": "omp"}
    say = [sys.executable, "-c", code]
    said = subprocess.run(say, capture_output=True, text=True, check=True, env=os.environ | threads)
    assert said.stdout == "1\n"


def test_an_error_in_a_thread_is_the_callers():
    def refuse(first: int, last: int) -> None:
        raise ValueError(f"items {first} to {last}")

    with pytest.raises(ValueError, match="items 0 to"):
        in_threads(refuse, 20)
