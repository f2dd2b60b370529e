"""Cost of data preparation: CPU time per view, scaling to workers, memory of a long recording.

    python benchmarks/bench_prepare.py [--only ids workers sens] [--rooms N] [--json FILE]

- ids: CPU time (all threads of the process) of one view's instance ids at 480 x 360, in a room of
  12 objects with 5,120 faces each, with 20 views per call; the median of 9 calls, in which the
  renderers alternate.
- workers: wall clock of preparing the same homes with one worker and with two, whole commands. It
  is meaningless on a busy machine, so the load average is printed.
- sens: peak memory of `prep-scannet` on a `.sens` of 1,000 frames of 1296 x 968, with payloads as
  large as the release's. The scan is written by the tests' writer.
"""

import argparse
import os
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from harness import children_cpu_s, machine, medians, report

from sceneprior.core.cameras import Pinhole, look_at
from sceneprior.core.errors import InputError
from sceneprior.core.proxies import icosphere
from sceneprior.core.scene import Mesh
from sceneprior.render.offscreen import open_renderer

SIZE = (360, 480)
PIECES, VIEWS = 12, 20


def furnished_room() -> list[Mesh]:
    """Ellipsoids the size of furniture in a room of 4 x 4 m."""
    rng = np.random.default_rng(0)
    sphere, faces = (part.numpy() for part in icosphere(4))
    return [
        Mesh(sphere * rng.uniform(0.15, 0.6, 3) + rng.uniform((-2, 0.2, -2), (2, 1.2, 2)), faces)
        for _ in range(PIECES)
    ]


def looking_in(angle: float) -> Pinhole:
    """A camera 2.6 m from the middle and 1.6 m up, with a field of view of 90 degrees."""
    eye = np.array([2.6 * np.cos(angle), 1.6, 2.6 * np.sin(angle)])
    height, width = SIZE
    return Pinhole(
        look_at(eye, np.array([0, 0.6, 0])),
        np.array([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1]]),
    )


def ids(repeats: int = 9) -> dict[str, Any]:
    """CPU milliseconds per view of each renderer, and the share of pixels that agree."""
    meshes = furnished_room()
    cameras = [looking_in(2 * np.pi * view / VIEWS) for view in range(VIEWS)]
    renderers = {}
    found: dict[str, Any] = {}
    for kind in ("software", "pyrender"):
        try:
            renderers[kind] = open_renderer(kind)
        except InputError as error:
            found[f"{kind}_ms"] = str(error)
    images = {
        kind: one.instance_ids_of_views(meshes, cameras, SIZE) for kind, one in renderers.items()
    }
    steps = {
        kind: partial(one.instance_ids_of_views, meshes, cameras, SIZE)
        for kind, one in renderers.items()
    }
    for kind, seconds in medians(steps, repeats, time.process_time).items():
        found[f"{kind}_ms"] = 1000 * seconds / VIEWS
        found[f"{kind}_name"] = renderers[kind].name
    if len(images) == 2:
        found["pixels_agree"] = float((images["software"] == images["pyrender"]).mean())
    return found


def workers(rooms: int) -> dict[str, float]:
    """Seconds of `prep-front` with one worker and with two: wall clock and CPU.

    The CPU seconds bound the speed-up on an idle machine with two cores. Starting two workers takes
    3 s of CPU, so the speed-up is smaller with few rooms.
    """
    found: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as name:
        homes = Path(name) / "homes"
        _sceneprior("make-homes", homes, "--rooms", rooms)
        for count, word in ((1, "one"), (2, "two")):
            wall, cpu = time.perf_counter(), children_cpu_s()
            _sceneprior(
                "prep-front", "--front", homes / "3D-FRONT", "--future", homes / "3D-FUTURE-model",
                "--out", Path(name) / str(count), "--renderer", "software", "--workers", count,
            )  # fmt: skip
            found[f"workers_{word}_s"] = time.perf_counter() - wall
            found[f"workers_{word}_cpu_s"] = children_cpu_s() - cpu
    found["workers_two_over_one"] = found["workers_one_s"] / found["workers_two_s"]
    found["workers_bound"] = 2 * found["workers_one_cpu_s"] / found["workers_two_cpu_s"]
    return found


def sens(
    frames: int = 1000, color_bytes: int = 150_000, depth_bytes: int = 250_000
) -> dict[str, float]:
    """Peak memory of `prep-scannet` on a long recording."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "data_prep" / "readers"))
    from scan_files import Box, ScanFolder, frame_header, png, sens_header, write_table, write_zip

    boxes = [Box("bed", (0, 0, 0), (2, 1.6, 0.6)), Box("chair", (2.5, 2, 0), (3, 2.5, 0.9))]
    with tempfile.TemporaryDirectory() as name:
        scans = Path(name) / "scans"
        for scan_id, count in (("scene0000_00", frames), ("scene0001_00", 30)):
            scan = ScanFolder(scans / scan_id, boxes, np.eye(4))
            scan.look((3.5, 3.5, 1.5), (1, 1, 0.3))
            scan.write()
            scan.poses *= count
            masks = {f"instance-filt/{k}.png": png(scan.mask(0)) for k in range(0, count, 15)}
            write_zip(scan.path("_2d-instance-filt.zip"), masks)
            with scan.path(".sens").open("wb") as file:
                file.write(sens_header(count, scan.size, K=scan.K))
                for frame, pose in enumerate(scan.poses):
                    file.write(frame_header(pose, frame, color_bytes, depth_bytes))
                    file.write(os.urandom(4096).ljust(color_bytes + depth_bytes, b"\1"))
                file.write(struct.pack("<Q", 0))
        table = write_table(Path(name) / "labels.tsv")
        for which, scan_id in (("train", "scene0000_00"), ("val", "scene0001_00")):
            (Path(name) / f"{which}.txt").write_text(scan_id + "\n")
        size = (scans / "scene0000_00" / "scene0000_00.sens").stat().st_size
        before = time.perf_counter()
        peak = _sceneprior(
            "prep-scannet", "--scans", scans, "--labels", table, "--out", Path(name) / "shards",
            "--train-list", Path(name) / "train.txt", "--val-list", Path(name) / "val.txt",
            "--workers", 1,
        )  # fmt: skip
        seconds = time.perf_counter() - before
    return {"sens_file_mb": size / 1e6, "sens_peak_mb": peak, "sens_s": seconds}


# On Linux, ru_maxrss includes the memory of the parent before `exec`; VmHWM does not.
_CHILD = """
import atexit, sys
def say():
    lines = open("/proc/self/status").read().splitlines()
    print(next(line.split()[1] for line in lines if line.startswith("VmHWM")))
atexit.register(say)
from sceneprior.apps.cli import main
sys.exit(main())
"""


def _sceneprior(*arguments: object) -> float:
    """Run a command of the package; returns its peak memory in MB, without worker processes."""
    words = [sys.executable, "-c", _CHILD, *map(str, arguments)]
    child = subprocess.run(words, capture_output=True, text=True, check=False)
    if child.returncode:
        sys.exit(f"{' '.join(words[3:])}\n{child.stdout}{child.stderr}")
    return int(child.stdout.split()[-1]) * 1024 / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    names = ["ids", "workers", "sens"]
    parser.add_argument("--only", nargs="+", choices=names, default=names)
    parser.add_argument("--rooms", type=int, default=240, help="number of rooms to prepare")
    parser.add_argument("--json", type=Path, help="also write the numbers to this file")
    arguments = parser.parse_args()
    parts: dict[str, Callable[[], dict[str, Any]]] = {
        "ids": ids,
        "workers": partial(workers, arguments.rooms),
        "sens": sens,
    }
    figures: dict[str, Any] = machine()
    for name in arguments.only:
        figures[f"{name}_load_average"] = os.getloadavg()[0]
        figures |= parts[name]()
    report(figures, arguments.json)


if __name__ == "__main__":
    main()
