"""Time of 2D boxes of ellipsoids: closed form against the authors' 2,562 projected vertices.

Run `python benchmarks/bench_boxes.py`. A step is a forward and backward pass, on the CPU, over a
batch of the layout stage: 128 rooms (32 with 2,562 vertices, since more need 6 GB), 13 objects, 20
views. The two variants alternate, so that other load on the machine affects both; values are
medians.
"""

import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from sceneprior.core.cameras import Boxes2D, boxes_of_points
from sceneprior.core.ellipsoids import boxes_of_ellipsoids
from sceneprior.core.meshes import icosphere, place

SIZE = (480, 640)


def make_batch(rooms: int, views: int, objects: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Centres, sizes, poses and intrinsics in 5 m rooms, with some objects behind the camera."""
    generator = torch.Generator().manual_seed(0)
    centers = torch.rand(rooms, objects, 3, generator=generator) * 5 - 2.5
    sizes = torch.rand(rooms, objects, 3, generator=generator) * 1.5 + 0.2
    turn = torch.linalg.qr(torch.randn(rooms, views, 3, 3, generator=generator))[0]
    cameras = torch.eye(4).repeat(rooms, views, 1, 1)
    cameras[..., :3, :3] = turn * torch.linalg.det(turn)[..., None, None]
    cameras[..., :3, 3] = torch.randn(rooms, views, 3, generator=generator)
    intrinsics = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]).expand(
        rooms, views, 3, 3
    )
    return centers.requires_grad_(), sizes.requires_grad_(), cameras, intrinsics


def boxes_ratio(
    repeats: int = 7,
    rooms: int = 128,
    views: int = 20,
    objects: int = 13,
    level: int = 4,
) -> dict[str, float]:
    """Median seconds of a step in closed form and with an icosphere (level 4 in the authors' code),
    after one warm-up step, and the ratio of the two."""
    centers, sizes, cameras, intrinsics = make_batch(rooms, views, objects)
    sphere = icosphere(level)[0].expand(rooms, objects, -1, -1)

    def closed() -> Boxes2D:
        return boxes_of_ellipsoids(centers, sizes, cameras, intrinsics, SIZE)

    def points() -> Boxes2D:
        return boxes_of_points(place(sphere, centers, sizes), cameras, intrinsics, SIZE)

    def seconds(boxes_of: Callable[[], Boxes2D]) -> float:
        centers.grad = sizes.grad = None
        start = time.perf_counter()
        boxes_of().boxes.sum().backward()
        return time.perf_counter() - start

    times: dict[str, list[float]] = {"closed": [], "points": []}
    for repeat in range(repeats + 1):
        for name, boxes_of in (("closed", closed), ("points", points)):
            spent = seconds(boxes_of)
            if repeat:  # the first repeat warms up
                times[name].append(spent)
    closed_s, points_s = (statistics.median(times[name]) for name in ("closed", "points"))
    return {"closed_s": closed_s, "points_s": points_s, "ratio": points_s / closed_s}


def processor() -> str:
    """Number of cores and CPU model, on Linux."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{len(names)} x {names[0]}" if names else platform.processor()


def main() -> None:
    print(f"{processor()}, load {os.getloadavg()[0]:.1f}; torch {torch.__version__}")
    for threads in sorted({1, torch.get_num_threads()}):
        torch.set_num_threads(threads)
        for name, level, rooms in (("162 vertices", 2, 128), ("2,562 (authors)", 4, 32)):
            found = boxes_ratio(repeats=3, rooms=rooms, level=level)
            print(
                f"{threads} threads, {rooms} rooms: closed form {found['closed_s'] * 1e3:.1f} ms, "
                f"{name} {found['points_s'] * 1e3:,.0f} ms: {found['ratio']:,.0f} times as fast",
                flush=True,
            )


if __name__ == "__main__":
    main()
