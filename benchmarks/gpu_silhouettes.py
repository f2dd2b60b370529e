"""Correctness and speed of silhouettes on a device; parts of `gpu.py`."""

import importlib.util
import time
from collections.abc import Callable
from itertools import product
from typing import Any

import torch
from bench_silhouettes import (
    OBJECTS,
    SIZE,
    VIEWS,
    forward_backward,
    furnished_room,
    medians,
    pytorch3d_step,
)
from gpu_setup import Setup, peak_mib
from torch import Tensor

from sceneprior.core.cameras import project
from sceneprior.render.silhouettes import render_scene
from sceneprior.render.silhouettes.render import COMPOSITING, MODES

SIGMA_PX2 = 0.25
"""A sigma that float32 represents exactly, since compiled kernels round sigma to float32."""


def kernels(setup: Setup) -> None:
    """Compare every mode, compositing and precision with the float64 reference on the device."""
    room, dtypes = _small_room(setup), (torch.float32, torch.float64)
    for mode, compositing, dtype in product(MODES, COMPOSITING, dtypes):
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
