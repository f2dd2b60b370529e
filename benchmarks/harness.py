"""Scaffolding of the benchmarks: the machine, medians of alternating steps, printed results."""

import json
import os
import platform
import resource
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

Steps = Mapping[str, Callable[[], object]]


def machine() -> dict[str, Any]:
    """Description of the machine, its load and the software."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        model = names[0].split(":", 1)[1].strip() if names else model
    return {
        "cpu": model,
        "cores": len(os.sched_getaffinity(0)),
        "load": round(os.getloadavg()[0], 1),
        "torch_threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def medians(
    steps: Steps | Callable[[int], Steps],
    repeats: int,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Median seconds of each step after one warm-up. Steps alternate, so that other load on the
    machine affects all equally; a function makes new steps for each repeat."""
    times: dict[str, list[float]] = {}
    for repeat in range(repeats + 1):
        for name, step in (steps(repeat) if callable(steps) else steps).items():
            start = clock()
            step()
            times.setdefault(name, []).append(clock() - start)
    return {name: statistics.median(values[1:]) for name, values in times.items()}


def children_cpu_s() -> float:
    """CPU seconds, user and system, of all child processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def report(figures: Mapping[str, Any], file: Path | None) -> None:
    """Print results line by line, and write them to a file if one is given."""
    for name, value in figures.items():
        print(f"{name:38}", f"{value:.4g}" if isinstance(value, float) else value, flush=True)
    if file is not None:
        file.write_text(json.dumps(figures, indent=2) + "\n")
