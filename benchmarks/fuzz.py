"""Damage files of every format that the package reads, and list what came of it.

    python benchmarks/fuzz.py --count 10000 --seed 1

Each mutation is to be read, or refused in one sentence; the exit status is 1 if one ends otherwise.
"""

import argparse
import sys
from pathlib import Path

TESTS = Path(__file__).parents[1] / "tests"
sys.path[:0] = map(str, (TESTS.parent, TESTS, TESTS / "data_prep", TESTS / "data_prep" / "readers"))


def main() -> None:
    from fuzzed_formats import FORMATS
    from fuzzing import MOST_RESIDENT, Fuzzer

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10_000, help="mutations of all formats")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", help="a part of the formats' names")
    given = parser.parse_args()
    names = [name for name in FORMATS if given.only is None or given.only in name]
    each, fuzzer, failed, total = -(-given.count // len(names)), Fuzzer(), list[str](), 0
    print(f"{'format':<58} mutations  read  refused  raw   CPU s  worst s  worst MB")
    for name in names:
        found = fuzzer.run(name, each, given.seed)
        total += each
        print(
            f"{name:<58} {each:>9} {found.read:>5} {found.refused:>8} {len(found.faults):>4} "
            f"{found.cpu_s:>7.1f} {found.slowest_s:>8.2f} {found.memory / 1e6:>9.0f}", flush=True,
        )  # fmt: skip
        failed += [f"{name}, {fault}" for fault in found.faults]
        failed += [f"{name}: 2 GB"] * (found.memory > MOST_RESIDENT)
    fuzzer.end()
    print(f"{total} mutations, {len(failed)} that end otherwise", *failed, sep="\n")
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
