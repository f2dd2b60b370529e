"""Speed of the silhouettes: a room of 13 meshes in 20 views, forward and backward.

    python benchmarks/bench_silhouettes.py [--json FILE]

The script measures the exact and the fast mode on the CPU (`gpu.py` measures a GPU), the torch
reference, and PyTorch3D if it is installed. Values are medians of
alternating runs, so that other load affects all equally; ratios are between medians of one run.
Compilation is reported separately and not included in medians.
"""

import argparse
import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from harness import machine, medians, report

from sceneprior.core.cameras import look_at
from sceneprior.core.proxies import icosphere
from sceneprior.render.silhouettes import render_scene

SIZE = (90, 120)
OBJECTS, VIEWS = 13, 20


def furnished_room(level: int, device: str = "cpu", rooms: int = 1) -> dict[str, Any]:
    """Ellipsoids the size of furniture in a room of 4 x 4 m, and cameras on a circle around it."""
    generator = np.random.default_rng(0)
    sphere, faces = icosphere(level)
    place = generator.uniform((-2, 0.2, -2), (2, 1.2, 2), (rooms, OBJECTS, 3))
    half = generator.uniform(0.15, 0.6, (rooms, OBJECTS, 3))
    vertices = sphere * torch.from_numpy(half)[:, :, None] + torch.from_numpy(place)[:, :, None]
    angles = 2 * np.pi * np.arange(VIEWS) / VIEWS
    eyes = [np.array([2.6 * np.cos(angle), 1.6, 2.6 * np.sin(angle)]) for angle in angles]
    poses = [look_at(eye, np.array([0, 0.6, 0])) for eye in eyes]
    height, width = SIZE
    intrinsics = torch.tensor([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1]])
    room = {
        "vertices_m": vertices.float(),
        "faces": faces,
        "world_to_camera": torch.from_numpy(np.array(poses)).float().expand(rooms, -1, -1, -1),
        "intrinsics": intrinsics.expand(rooms, VIEWS, 3, 3),
    }
    return {key: value.to(device) for key, value in room.items()} | {"image_size": SIZE}


def forward_backward(room: dict[str, Any], **options: Any) -> Callable[[], None]:
    """A step that draws like training: masks, front-most ids, and the vertices' gradient."""
    shape = (*room["world_to_camera"].shape[:2], room["vertices_m"].shape[1], *SIZE)
    upstream = torch.rand(shape, device=room["vertices_m"].device)

    def step() -> None:
        vertices = room["vertices_m"].clone().requires_grad_()
        scene = render_scene(**(room | {"vertices_m": vertices}), **options)
        scene.masks.backward(upstream)
        if vertices.is_cuda:
            torch.cuda.synchronize()

    return step


def reference_seconds() -> float:
    """Seconds of the torch reference on one object in one view, times 13 x 20.

    The reference draws objects one by one, and stores every pair of face and pixel, so that a whole
    room would need tens of GiB.
    """
    room = furnished_room(3)
    part = room | {key: room[key][:, :1] for key in ("world_to_camera", "intrinsics", "vertices_m")}
    step = forward_backward(part, backend="reference")
    return medians({"reference": step}, 1)["reference"] * OBJECTS * VIEWS


def first_call_seconds(mode: str) -> dict[str, float]:
    """Seconds of the first step of a new process, when compiling and with a warm cache."""
    code = (
        "import time, sys; sys.path.insert(0, sys.argv[1]); import bench_silhouettes as b; "
        "step = b.forward_backward(b.furnished_room(1), mode=sys.argv[2]); "
        "start = time.perf_counter(); step(); print(time.perf_counter() - start)"
    )
    seconds = {}
    cache = Path(os.environ.get("TMPDIR", "/tmp")) / f"sceneprior_bench_{os.getpid()}_{mode}"
    for what in ("compiling", "cached"):
        done = subprocess.run(
            [sys.executable, "-c", code, str(Path(__file__).parent), mode],
            env=os.environ | {"NUMBA_CACHE_DIR": str(cache)},
            capture_output=True,
            text=True,
            check=True,
        )
        seconds[what] = float(done.stdout)
    return seconds


def peak_extra_mib(**options: Any) -> float:
    """Peak memory of one forward and backward, including dense masks and their gradient."""
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); import bench_silhouettes as b; "
        f"print(b.memory_growth(**{options!r}))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(Path(__file__).parent)],
        capture_output=True,
        text=True,
        check=True,
    )
    return float(done.stdout)


def memory_growth(**options: Any) -> float:
    """Growth of the peak resident memory by one forward and backward, in MiB (Linux)."""
    room = furnished_room(3)
    one = room | {key: room[key][:, :1] for key in ("world_to_camera", "intrinsics")}
    forward_backward(one, **options)()  # loads all code
    step = forward_backward(room, **options)
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak
    before = status_mib("VmRSS")
    step()
    return status_mib("VmHWM") - before


def status_mib(name: str) -> float:
    line = next(x for x in Path("/proc/self/status").read_text().splitlines() if name in x)
    return int(line.split()[1]) / 1024


def pytorch3d_seconds(repeats: int) -> float | str:
    """Seconds of PyTorch3D's soft silhouettes of the same room, one joined mesh per view, as in the
    authors' code (nvdiffrast needs a GPU; see `gpu.py`)."""
    if importlib.util.find_spec("pytorch3d") is None:
        return "not installed"
    step = pytorch3d_step(furnished_room(3))
    return medians({"it": step}, min(repeats, 2))["it"]


def pytorch3d_step(room: dict[str, Any]) -> Callable[[], None]:
    """A forward and backward step by PyTorch3D, on the device of the room."""
    from pytorch3d.renderer import (
        BlendParams,
        MeshRasterizer,
        MeshRenderer,
        RasterizationSettings,
        SoftSilhouetteShader,
    )
    from pytorch3d.structures import Meshes
    from pytorch3d.utils import cameras_from_opencv_projection

    device = room["vertices_m"].device
    poses, intrinsics = room["world_to_camera"][0], room["intrinsics"][0]
    size = torch.tensor([SIZE], device=device).expand(VIEWS, -1)
    cameras = cameras_from_opencv_projection(poses[:, :3, :3], poses[:, :3, 3], intrinsics, size)
    settings = RasterizationSettings(SIZE, np.log(1 / 1e-4 - 1) * 1e-4, 50, bin_size=0)
    renderer = MeshRenderer(
        MeshRasterizer(cameras, settings), SoftSilhouetteShader(BlendParams(sigma=1e-4))
    )
    per_object = room["vertices_m"].shape[2]
    faces = torch.cat([room["faces"] + k * per_object for k in range(OBJECTS)])
    upstream = torch.rand(VIEWS, *SIZE, device=device)

    def step() -> None:
        vertices = room["vertices_m"].clone().requires_grad_()
        joined = vertices.reshape(1, -1, 3).expand(VIEWS, -1, -1)
        masks = renderer(Meshes(joined, faces.expand(VIEWS, -1, -1)))[..., 3]
        masks.backward(upstream)
        if device.type == "cuda":
            torch.cuda.synchronize()

    return step


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--json", type=Path, help="also write the numbers to this file")
    parser.add_argument("--repeats", type=int, default=15)
    arguments = parser.parse_args()
    figures: dict[str, Any] = {}

    def note(**found: Any) -> None:
        figures.update(found)
        report(found, None)

    note(**machine())
    steps = {
        f"{mode}{tag}": forward_backward(furnished_room(level), mode=mode)
        for mode in ("exact", "fast")
        for tag, level in (("", 3), ("_5120", 4))
    }
    times = medians(steps, arguments.repeats)
    note(**{f"{name}_fwd_bwd_s": seconds for name, seconds in times.items()})
    note(fast_ratio=times["exact"] / times["fast"])
    for mode in ("exact", "fast"):
        note(**{f"{mode}_5120_over_1280": times[f"{mode}_5120"] / times[mode]})
    for mode in ("exact", "fast"):
        note(**{f"{mode}_alone_peak_extra_mib": peak_extra_mib(mode=mode, compositing="alone")})
        note(**{f"{mode}_first_call_s": first_call_seconds(mode)})
    reference = reference_seconds()
    note(reference_fwd_bwd_s=reference, reference_ratio=reference / times["exact"])
    note(pytorch3d=pytorch3d_seconds(arguments.repeats))
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
