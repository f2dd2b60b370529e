"""Time of evaluating rooms: synthesis and scoring, with and without a reference file.

Run `python benchmarks/bench_evaluation.py --run RUN [--shards SHARDS] [-n 1000]`. CPU seconds of
all threads and wall-clock seconds are listed; on a busy machine, only the CPU seconds are
meaningful.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console
from rich.table import Table

from sceneprior.apps.config import load_run
from sceneprior.apps.sample import sample_rooms
from sceneprior.evaluation.synthesis import EvalOptions, evaluate_synthesis

T = TypeVar("T")


def measure(work: Callable[[], T]) -> tuple[T, dict[str, float]]:
    """Run `work`; returns its result, and CPU and wall-clock seconds."""
    cpu, wall = time.process_time(), time.perf_counter()
    result = work()
    return result, {
        "cpu_s": round(time.process_time() - cpu, 2),
        "wall_s": round(time.perf_counter() - wall, 2),
    }


def time_evaluation(run: Path, shards: Path | None, count: int) -> dict[str, Any]:
    """Seconds of synthesis and of scoring; each value is also printed once it is measured."""
    seconds: dict[str, Any] = {}

    def timed(name: str, work: Callable[[], T]) -> T:
        result, seconds[name] = measure(work)
        print(name, seconds[name], flush=True)
        return result

    trained = timed("load", lambda: load_run(run))
    folder = shards or Path(trained.config.data.shards)
    scenes = timed("synthesize", lambda: sample_rooms(trained, count, seed=0))

    def score(name: str, **options: Any) -> None:
        timed(
            name,
            lambda: evaluate_synthesis(scenes, folder, EvalOptions(**options)),
        )

    warm = EvalOptions(resamples=0)
    evaluate_synthesis(scenes[:2], folder, warm)  # compiles, loads, warms
    score("score")
    score("without_intervals", resamples=0)
    return seconds


def main() -> None:
    """Print the table, and write it as JSON if `--json` is given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, required=True)
    parser.add_argument("--shards", type=Path)
    parser.add_argument("-n", "--count", type=int, default=1000)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    seconds = time_evaluation(arguments.run, arguments.shards, arguments.count)
    table = Table(title=f"Evaluating {arguments.count} rooms")
    for heading in ("", "CPU s", "wall s"):
        table.add_column(heading, justify="right" if heading else "left")
    for name, taken in seconds.items():
        table.add_row(name.replace("_", " "), f"{taken['cpu_s']:.1f}", f"{taken['wall_s']:.1f}")
    Console().print(table)
    if arguments.json:
        arguments.json.write_text(json.dumps(seconds, indent=1) + "\n")


if __name__ == "__main__":
    main()
