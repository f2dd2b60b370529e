"""Parts of `gpu.py`: correctness and speed of silhouettes; steps, memory, precision, whole schedule
and two processes of the paper's run on procedural homes."""

import importlib.util
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import torch
from bench_processes import compare
from bench_silhouettes import (
    OBJECTS,
    SIZE,
    VIEWS,
    forward_backward,
    furnished_room,
    pytorch3d_step,
)
from harness import medians
from timed_fit import CONFIG, StageTimes, made_shards, paper_run, timed_fit
from torch import Tensor

from sceneprior.apps.config import load_config
from sceneprior.core.cameras import project
from sceneprior.core.settings import find_config
from sceneprior.render.silhouettes import render_scene
from sceneprior.render.silhouettes.render import COMPOSITING, MODES


@dataclass(frozen=True)
class Sizes:
    """Sizes of the measurements."""

    compared_level: int = 2
    """Level of the icospheres in the comparison with the reference; 2 has 320 faces."""
    compared_objects: int = 3
    compared_views: int = 2
    compared_shrink: int = 2
    """Divisor of the image size, 120 x 90, in that comparison."""
    levels: tuple[int, ...] = (3, 4)
    """Levels of the icospheres that are timed: 1,280 faces, and the paper's 5,120."""
    rooms: int = 16
    """Rooms per batch, for timing silhouettes and for training the paper's run."""
    large_batch: int = 128
    """Rooms per batch of an additional run, for memory."""
    repeats: int = 15
    homes: int = 96
    """Procedural homes, 67 of them for training: 268 rows with their turned copies."""
    epochs: int = 5
    steps: int = 40
    """Most steps of an epoch in the part `graphs`."""
    compared_steps: int = 20
    """Steps after which that part compares weights."""
    changes: tuple[str, ...] = ()
    """Changes to the paper's config."""
    kernels: tuple[tuple[str, str, torch.dtype], ...] = tuple(
        product(MODES, COMPOSITING, (torch.float32, torch.float64))
    )
    """Mode, compositing and precision of the compared kernels."""


PAPER = Sizes()
TINY = Sizes(
    compared_level=1, compared_objects=2, compared_views=1, compared_shrink=6, levels=(0,), rooms=2,
    large_batch=4, repeats=1, homes=6, epochs=3, steps=3, compared_steps=2,
    changes=(
        "model.width=16", "model.decoder.heads=2", "model.decoder.hidden=16", "data.workers=0",
        "model.latent_space.anchors=10", "model.shape.width=8", "model.shape.level=1",
        "data.views_per_room=2", "layout.cpu_threads=1", "shape.cpu_threads=1",
    ),
)  # fmt: skip
"""Sizes for a test on a CPU."""
BRIEF = Sizes(
    kernels=(("exact", "paper", torch.float32), ("fast", "layered", torch.float32)),
    levels=(3,), repeats=5,
)  # fmt: skip
"""Sizes for a few minutes of a GPU: the kernels that training uses."""


@dataclass(frozen=True)
class Setup:
    """Settings with which a part is called."""

    device: str
    sizes: Sizes
    folder: Path
    """Folder shared by all parts, which keeps the homes."""
    note: Callable[[str, dict[str, float]], None]
    """Function that immediately writes a row of the part's table, from the row's title and values
    by name; names end in units."""
    shards: Path | None = None
    """Shards to train on; None makes homes."""
    flat: Path | None = None
    """Views of thousands of rooms, for the part `sphere`."""
    until: float = 0.0
    """Time, as of `time.time()`, at which the part is stopped."""


@contextmanager
def peak_mib(device: str) -> Iterator[Callable[[], float]]:
    """Yield a function that returns the peak MiB of tensors on the GPU since entry; 0 on a CPU."""
    if device == "cpu":
        yield lambda: 0.0
        return
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    yield lambda: torch.cuda.max_memory_allocated() / 2**20


SIGMA_PX2 = 0.25
"""A sigma that float32 represents exactly, since compiled kernels round sigma to float32."""


def kernels(setup: Setup) -> None:
    """Compare every mode, compositing and precision with the float64 reference on the device."""
    room = _small_room(setup)
    for mode, compositing, dtype in setup.sizes.kernels:
        how = {"mode": mode, "compositing": compositing, "sigma_px2": SIGMA_PX2}
        rounded = room | {
            name: value.to(dtype).double() for name, value in room.items() if _is_real(value)
        }
        wanted = _drawn(rounded, backend="reference", **how)
        exactly = {name: v.to(dtype) if _is_real(v) else v for name, v in room.items()}
        start = time.perf_counter()
        got = _drawn(exactly, **how)
        first_s = time.perf_counter() - start
        again = _drawn(exactly, **how)
        masks, front, gradient = (one.double() - two for one, two in zip(got, wanted, strict=True))
        same = all(torch.equal(one, two) for one, two in zip(got, again, strict=True))
        setup.note(
            f"{mode}, {compositing}, {str(dtype).removeprefix('torch.')}",
            {
                "masks_off": float(masks.abs().max()),
                "gradient_off": float(gradient.abs().max() / wanted[2].abs().max()),
                "front_differs": float((front != 0).double().mean()),
                "same_bits_again": float(same),
                "first_call_s": first_s,
            },
        )


def _is_real(value: Any) -> bool:
    return isinstance(value, Tensor) and value.is_floating_point()


def _small_room(setup: Setup) -> dict[str, Any]:
    """A room of few objects and views, since the reference stores every pair of face and pixel."""
    sizes = setup.sizes
    room = furnished_room(sizes.compared_level, setup.device)
    room["vertices_m"] = room["vertices_m"][:, : sizes.compared_objects]
    shrunk = room["intrinsics"].clone()
    shrunk[..., :2, :] /= sizes.compared_shrink
    room |= {
        "world_to_camera": room["world_to_camera"][:, : sizes.compared_views],
        "intrinsics": shrunk[:, : sizes.compared_views],
        "image_size": tuple(side // sizes.compared_shrink for side in SIZE),
    }
    return room


def _drawn(room: dict[str, Any], **how: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Masks, front-most ids and the vertices' gradient of a fixed random sum of the masks."""
    vertices = room["vertices_m"].clone().requires_grad_()
    scene = render_scene(**(room | {"vertices_m": vertices}), **how)
    generator = torch.Generator().manual_seed(1)
    upstream = torch.rand(scene.masks.shape, generator=generator, dtype=torch.float64)
    scene.masks.backward(upstream.to(scene.masks))
    assert vertices.grad is not None
    return scene.masks.detach(), scene.front, vertices.grad


def speed(setup: Setup) -> None:
    """Time forward and backward of 13 objects in 20 views at 120 x 90; one room also on the CPU."""
    for level, rooms in product(setup.sizes.levels, (1, setup.sizes.rooms)):
        room = furnished_room(level, setup.device, rooms)
        for mode in MODES:
            step = forward_backward(room, mode=mode)
            with peak_mib(setup.device) as peak:
                seconds = medians({mode: step}, setup.sizes.repeats)[mode]
            what = f"{mode}, rooms: {rooms}, faces per object: {len(room['faces']):,}"
            setup.note(what, {"forward_backward_s": seconds, "peak_mib": peak()})
    room = furnished_room(setup.sizes.levels[0])
    for mode in MODES:
        seconds = medians({mode: forward_backward(room, mode=mode)}, setup.sizes.repeats)[mode]
        what = f"{mode}, rooms: 1, faces per object: {len(room['faces']):,}; on the CPU beside it"
        setup.note(what, {"forward_backward_s": seconds})


def peers(setup: Setup) -> None:
    """Time PyTorch3D, with the authors' settings, and nvdiffrast on the same room, if installed."""
    level = setup.sizes.levels[0]
    steps: dict[str, Callable[[], None]] = {
        mode: forward_backward(furnished_room(level, setup.device), mode=mode) for mode in MODES
    }
    makers = {"pytorch3d": pytorch3d_step, "nvdiffrast": nvdiffrast_step}
    for name, make in makers.items():
        if importlib.util.find_spec(name) is None:
            setup.note(f"{name}: not installed", {})
            continue
        try:
            theirs = make(furnished_room(level, setup.device))
            times = medians(steps | {name: theirs}, setup.sizes.repeats)
        except Exception as error:  # e.g. built for another GPU; the next one is still measured
            setup.note(f"{name}: {' '.join(str(error).split())[:200]}", {})
            continue
        ratios = {f"over_{mode}": times[name] / times[mode] for mode in MODES}
        setup.note(name, {"forward_backward_s": times[name], **ratios})


def nvdiffrast_step(room: dict[str, Any]) -> Callable[[], None]:
    """A step that draws nvdiffrast's antialiased masks of one room, with their gradient."""
    import nvdiffrast.torch as dr

    device = room["vertices_m"].device
    context = dr.RasterizeCudaContext()
    per_object = room["vertices_m"].shape[2]
    faces = torch.cat([room["faces"] + k * per_object for k in range(OBJECTS)]).int()
    ids = torch.eye(OBJECTS, device=device).repeat_interleave(per_object, 0)
    upstream = torch.rand(VIEWS, *SIZE, OBJECTS, device=device)
    half = torch.tensor([SIZE[1] / 2, SIZE[0] / 2], device=device)

    def step() -> None:
        vertices = room["vertices_m"].clone().requires_grad_()
        seen = project(vertices, room["world_to_camera"], room["intrinsics"])[0].flatten(1, 2)
        z = seen[..., 2:]
        clip = torch.cat([(seen[..., :2] / half - 1) * z, z - 0.1, z], dim=-1).contiguous()
        raster, _ = dr.rasterize(context, clip, faces, SIZE)
        color, _ = dr.interpolate(ids[None], raster, faces)
        dr.antialias(color.contiguous(), raster, clip, faces).backward(upstream)
        torch.cuda.synchronize()

    return step


PAPER_ROOMS = 3530
"""Number of the paper's training bedrooms: 90% of 3,922."""
PRECISIONS = {
    "float32": ("32-true", "highest"),
    "TF32, as `fit` does": ("32-true", "high"),
    "bf16-mixed, TF32 beside it": ("bf16-mixed", "high"),
}


def homes(setup: Setup) -> None:
    """Make homes and prepare their shards, on the CPU."""
    start = time.perf_counter()
    made_shards(setup.folder, setup.sizes.homes, len(os.sched_getaffinity(0)))
    seconds = time.perf_counter() - start
    setup.note("homes made and prepared", {"homes": setup.sizes.homes, "seconds": seconds})


def schedule(setup: Setup) -> None:
    """Time a few epochs of the paper's run; extrapolate to the whole schedule."""
    whole = load_config(str(find_config(CONFIG)))
    epochs = {stage.name: stage.settings.epochs for stage in whole.stages()}
    config = paper_run(shards_of(setup), setup.sizes.epochs, *changes_of(setup, setup.sizes.rooms))
    hours: dict[str, float] = {}

    def ended(stage: str, times: StageTimes) -> None:
        hours[stage] = whole_epochs_s(times, epochs[stage], whole.data.rotations) / 3600
        what = f"{stage} stage; whole: {epochs[stage]} epochs"
        setup.note(what, times.figures() | {"whole_h": hours[stage]})

    with tempfile.TemporaryDirectory() as name:
        options = {"accelerator": setup.device, "devices": 1}
        timed_fit(config, Path(name) / "run", options, ended=ended)
    what = f"all of {CONFIG} on {PAPER_ROOMS:,} rooms, extrapolated"
    setup.note(what, {"whole_h": sum(hours.values())})


def whole_epochs_s(times: StageTimes, epochs: int, rotations: int) -> float:
    """Seconds of `epochs` epochs on the paper's rooms, extrapolated at equal time per row."""
    return epochs * times.epoch_s * PAPER_ROOMS * rotations / times.rooms


def batches(setup: Setup) -> None:
    """Time the steps with more rooms per batch."""
    batch = setup.sizes.large_batch
    _time(setup, f"{batch} rooms per batch", "32-true", "high", batch)


def precision(setup: Setup) -> None:
    """Time both stages in each precision."""
    for name, (bits, matmul) in PRECISIONS.items():
        _time(setup, name, bits, matmul, setup.sizes.rooms)


def _time(setup: Setup, what: str, bits: str, matmul: str, batch: int) -> None:
    def ended(stage: str, times: StageTimes) -> None:
        setup.note(f"{stage} stage, {what}", times.figures())

    config = paper_run(shards_of(setup), setup.sizes.epochs, *changes_of(setup, batch))
    options = {"accelerator": setup.device, "devices": 1, "precision": bits}
    with tempfile.TemporaryDirectory() as name:
        timed_fit(config, Path(name) / "run", options, matmul, ended=ended)


def processes(setup: Setup) -> None:
    """Compare two processes, which share each batch and the device, with one."""
    shards, sizes = shards_of(setup), setup.sizes
    with tempfile.TemporaryDirectory() as name:
        changes = changes_of(setup, sizes.rooms)
        found = compare(shards, Path(name), setup.device, sizes.epochs, 1, changes)
    for stage, figures in found.items():
        setup.note(f"{stage} stage", figures)


def shards_of(setup: Setup) -> Path:
    if setup.shards is not None:
        return setup.shards.absolute()
    return made_shards(setup.folder, setup.sizes.homes, len(os.sched_getaffinity(0))).absolute()


def changes_of(setup: Setup, batch: int) -> tuple[str, ...]:
    return (*setup.sizes.changes, f"layout.batch_size={batch}", f"shape.batch_size={batch}")
