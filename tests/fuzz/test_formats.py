"""Damaged files of every format: each is read, or refused in one sentence, in time and memory.

A failure prints its cases; `python benchmarks/fuzz.py --only NAME` repeats those of a format.
"""

import pytest
from fuzzed_formats import FORMATS
from fuzzing import MOST_RESIDENT, Fuzzer

MUTATIONS = 300


@pytest.fixture(scope="module")
def fuzzer():
    fuzzer = Fuzzer()
    yield fuzzer
    fuzzer.end()


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files_are_read_or_refused_in_one_sentence(fuzzer, name):
    found = fuzzer.run(name, MUTATIONS, seed=0)
    assert not found.faults
    assert found.memory < MOST_RESIDENT
    # Mutations that all pass test nothing, unless the file is made again.
    assert found.refused or name in MADE_AGAIN


MADE_AGAIN = {"lifted cache", "CAD cache", "report.json", "metrics.csv"}
"""Formats of files that are made again, or whose damaged parts are left out."""
