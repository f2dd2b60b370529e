"""Cost of each step from data to training, and its growth with the numbers of rooms and objects.

    python benchmarks/bench_scale.py [--rooms 500 2000 6000] [--json FILE] [--folder DIR]

For each number of rooms, separate processes make bedrooms, prepare them with two workers, and
inspect them; load every room's 20 views with masks at a quarter of the size, twice; and train a few
steps of both stages of the paper's run (configs/paper/bedroom.yaml). For each step, the table lists
wall clock, CPU seconds of the process and its children, peak memory of the largest process, and the
growth exponent of CPU seconds from each number of rooms to the next.

The benchmark also times a layout step of the paper's size with as many objects as bedrooms, living
rooms and ScanNet scenes hold (128 rooms of 20 views, one thread), and extrapolates the paper's full
schedule on this machine: number of steps times median step time.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

EPOCHS, STEPS = 3, 1
"""Number of epochs per stage (the first compiles, the last evaluates), and steps per epoch."""
ROOMS, OBJECTS = 128, (13, 28, 53)
"""Rooms per layout step; maximum numbers of objects in bedrooms, living rooms and ScanNet."""


def child(*words: object) -> dict[str, Any]:
    """Run a command; returns its seconds, CPU seconds and peak memory, children included."""
    began = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    assert process.stdout is not None
    said = process.stdout.read().decode(errors="replace")
    _, status, used = os.wait4(process.pid, 0)
    if status:
        sys.exit(f"{' '.join(map(str, words))}\n{said}")
    found = {
        "clock_s": time.perf_counter() - began,
        "cpu_s": used.ru_utime + used.ru_stime,
        "peak_mb": used.ru_maxrss * 1024 / 1e6,  # includes this process, which is smaller
    }
    last = said.strip().rpartition("\n")[2]
    return found | (json.loads(last) if last.startswith("{") else {})


def data_set(folder: Path, rooms: int) -> dict[str, dict[str, float]]:
    """Measurements of every step, by name."""
    homes, shards, command = folder / "homes", folder / "shards", ("-m", "sceneprior")
    steps: dict[str, tuple[object, ...]] = {
        "make-homes": (*command, "make-homes", homes, "--rooms", rooms),
        "prep-front": (
            *command, "prep-front", "--front", homes / "3D-FRONT",
            "--future", homes / "3D-FUTURE-model", "--out", shards, "--workers", 2,
        ),
        "inspect": (*command, "inspect", shards, "--verify"),
        "load": (__file__, "--part", "load", shards),
        "train": (__file__, "--part", "train", shards),
    }  # fmt: skip
    found = {}
    for name, words in steps.items():
        found[name] = child(*words)
        print(f"{rooms:6} {name:12}", _told(found[name]), flush=True)
    found["prep-front"]["disk_mb"] = sum(
        path.stat().st_size for path in shards.rglob("*.h5")
    ) / 1e6  # fmt: skip
    return found


def load(shards: Path) -> dict[str, float]:
    """Time two epochs of the shape stage's batches, without turned copies, which read no files."""
    from sceneprior.core.dataset import ViewDataset

    began = time.perf_counter()
    rooms = ViewDataset(shards, "train", 20, mask_step=4)
    marks = [began, time.perf_counter()]
    for epoch in range(2):
        for first in range(0, len(rooms), 16):
            rooms.__getitems__([(row, epoch) for row in range(first, min(first + 16, len(rooms)))])
        marks.append(time.perf_counter())
    names = ("open_s", "first_epoch_s", "second_epoch_s")
    return dict(zip(names, [end - start for start, end in pairwise(marks)], strict=True))


def train(shards: Path) -> dict[str, float]:
    """Time a few steps of both stages, and extrapolate the full schedule."""
    from sceneprior.apps.config import load_config  # before torch, which starts OpenMP

    from timed_fit import CONFIG, paper_run, timed_fit  # isort: skip

    with tempfile.TemporaryDirectory() as folder:
        limited = {"limit_train_batches": STEPS, "accelerator": "cpu", "devices": 1}
        run = paper_run(shards, EPOCHS, "data.workers=0")
        stages = timed_fit(run, Path(folder) / "run", limited)
    found: dict[str, float] = {}
    for stage in load_config(CONFIG).stages():  # with all epochs of the paper
        name, times = stage.name, stages[stage.name]
        steps = math.ceil(times.rooms / stage.settings.batch_size) * stage.settings.epochs
        found |= {
            f"{name}_step_s": times.step_s,
            f"{name}_hours": steps * times.step_s / 3600,
            f"{name}_rows": times.rooms,
        }
    return found


def layout_steps(_: Path) -> dict[str, float]:
    """Median CPU seconds of a layout step, by the number of objects."""
    import torch
    from bench_layout_step import make_views, our_step
    from harness import medians

    from sceneprior.apps.config import load_config
    from sceneprior.paper.config import PaperConfig

    torch.set_num_threads(1)
    found = {}
    for objects in OBJECTS:
        config = load_config("bedroom.yaml", (f"model.max_objects={objects}",))
        assert isinstance(config, PaperConfig)
        prior, views = config.build_prior(), make_views(ROOMS, 20, objects)
        logits = torch.randn(ROOMS, config.model.logits_per_room)

        def step(prior=prior, views=views, config=config, logits=logits) -> None:
            prior.zero_grad()
            our_step(prior, prior.latent_space(logits), views, config)

        found[str(objects)] = medians({"step": step}, 3, time.process_time)["step"]
    return found


def powers(counts: list[int], seconds: list[float]) -> list[float]:
    """Exponents p of the growth seconds ~ counts**p, from each count to the next."""
    logs = [(math.log(n), math.log(s)) for n, s in zip(counts, seconds, strict=True)]
    return [(s1 - s0) / (n1 - n0) for (n0, s0), (n1, s1) in pairwise(logs)]


PARTS: dict[str, Callable[[Path], dict[str, Any]]] = {
    "load": load, "train": train, "objects": layout_steps,
}  # fmt: skip
"""Tasks of child processes that are not commands of the package."""


def _told(figures: dict[str, float]) -> str:
    return "  ".join(f"{name} {value:.4g}" for name, value in figures.items())


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--rooms", nargs="+", type=int, default=[500, 2000, 6000])
    parser.add_argument("--json", type=Path, help="also write the numbers to this file")
    parser.add_argument("--folder", type=Path, help="folder that keeps the generated files")
    parser.add_argument("--part", nargs=2, help=argparse.SUPPRESS)  # for child processes
    arguments = parser.parse_args()
    if arguments.part:
        name, shards = arguments.part
        print(json.dumps(PARTS[name](Path(shards))))
        return
    figures: dict[str, Any] = {"cores": os.cpu_count(), "load": os.getloadavg()[0]}
    with tempfile.TemporaryDirectory() as name:
        folder = arguments.folder or Path(name)
        by_rooms = {count: data_set(folder / str(count), count) for count in arguments.rooms}
    figures |= {"by_rooms": by_rooms, "by_objects": child(__file__, "--part", "objects", ".")}
    for step in next(iter(by_rooms.values())):
        seconds = [by_rooms[count][step]["cpu_s"] for count in arguments.rooms]
        grown = " ".join(f"{power:.2f}" for power in powers(arguments.rooms, seconds))
        print(f"{step:12} CPU s {' '.join(f'{s:.4g}' for s in seconds)}  power {grown}")
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
