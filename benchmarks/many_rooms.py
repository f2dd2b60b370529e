"""Rooms drawn with files and settled, by processes and by a Dask cluster of this machine.

    python benchmarks/many_rooms.py [--rooms N] [--run RUN] [--json FILE]

Each way of working draws the same rooms, writes their JSON, GLB and PNG, reads them, and exports
them to MuJoCo, which settles them. It reports the seconds until workers have imported the package,
loaded the prior and made their first rooms; then rooms per second, CPU seconds of all processes
and, from a thousand empty tasks, the milliseconds that a task costs besides its work. On a busy
machine, compare CPU seconds. The bytes that pass between command and workers are measured, too.
"""

import argparse
import contextlib
import json
import os
import pickle
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from harness import machine, report

from sceneprior.apps.api import load
from sceneprior.apps.rooms import writing_scenes
from sceneprior.core.parallel import on_workers, run_tasks
from sceneprior.core.scene import Scene
from sceneprior.interchange.export import export_scenes
from sceneprior.paper.sampling import BATCH
from sceneprior.render.scene_files import load_scene_folder

EMPTY_TASKS = 1000
WAYS = ("processes", 1), ("processes", 2), ("dask", 1), ("dask", 2)
ROWS = (
    (f"start and the first {BATCH} rooms a worker, s", "start_s", ".0f"),
    ("drawn, with files, rooms a second", "drawn_rooms_per_s", ".1f"),
    ("exported to MuJoCo, rooms a second", "settled_rooms_per_s", ".1f"),
    ("read, ms a room", "reading_ms_a_room", ".0f"),
    ("CPU seconds in all", "cpu_s_in_all", ".0f"),
    ("an empty task, ms", "empty_task_ms", ".2f"),
)


def nothing(number: int) -> int:
    """The empty task."""
    return number


def draw(run: str, rooms: int, seed: int, out: Path) -> list[Scene]:
    """Draw rooms with files, as `synthesize` does."""
    with writing_scenes(out) as (write, scenes):
        scenes += load(run).sample(rooms, seed, then=write)
    return scenes


@contextlib.contextmanager
def workers_of(way: str, count: int) -> Iterator[None]:
    """`count` processes, or as many Dask workers."""
    if way == "processes":
        with on_workers(count):
            yield
        return
    from distributed import LocalCluster

    cluster = LocalCluster(n_workers=count, threads_per_worker=1, dashboard_address=None)
    with cluster, on_workers(scheduler=cluster.scheduler_address):
        yield


def cpu_s() -> float:
    """CPU seconds of this process and of the children that have ended."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


def measure(way: str, count: int, run: str, rooms: int, folder: Path) -> dict[str, float]:
    """Measurements of one way of working."""
    cpu, begin = cpu_s(), time.perf_counter()
    with workers_of(way, count):
        draw(run, count * BATCH, 1, folder / "first")
        ready = time.perf_counter()
        drawn = draw(run, rooms, 0, folder / "rooms")
        written = time.perf_counter()
        scenes = load_scene_folder(folder / "rooms", with_materials=True)
        read = time.perf_counter()
        export_scenes(scenes, "mujoco", folder / "mujoco")
        settled = time.perf_counter()
        run_tasks(nothing, {str(number): (number,) for number in range(EMPTY_TASKS)})
        empty = time.perf_counter()
    key = f"{way}_{count}"
    return {
        f"{key}_start_s": ready - begin,
        f"{key}_drawn_rooms_per_s": rooms / (written - ready),
        f"{key}_settled_rooms_per_s": rooms / (settled - read),
        f"{key}_reading_ms_a_room": 1e3 * (read - written) / rooms,
        f"{key}_cpu_s_in_all": cpu_s() - cpu,
        f"{key}_empty_task_ms": 1e3 * (empty - settled) / EMPTY_TASKS,
        "kb_a_drawn_room_comes_back": len(pickle.dumps(drawn)) / rooms / 1e3,
        "kb_a_settled_room_goes_there": len(pickle.dumps(scenes)) / rooms / 1e3,
    }


def print_table(found: dict[str, float]) -> None:
    """Print the table of docs/cluster.md."""
    titles = "this process", "2 processes", "Dask, 1 worker", "Dask, 2 workers"
    print(f"| {found['rooms']} rooms |", " | ".join(titles), "|")
    print("| ---", *["| ---:"] * len(titles), "|")
    for title, key, form in ROWS:
        cells = (format(found[f"{way}_{count}_{key}"], form) for way, count in WAYS)
        print(f"| {title} |", " | ".join(cells), "|")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rooms", type=int, default=512)
    parser.add_argument("--run", default="procthor-bedroom")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    found: dict[str, float] = {"rooms": arguments.rooms}
    for way, count in WAYS:
        print(f"{way}, {count}:", json.dumps(machine()), flush=True)
        with tempfile.TemporaryDirectory() as name:
            found |= measure(way, count, arguments.run, arguments.rooms, Path(name))
    report(found, arguments.json)
    print_table(found)


if __name__ == "__main__":
    main()
