"""Time of a training step of the layout stage, in this package and done like the authors' code.

    python benchmarks/bench_layout_step.py [--rooms 128] [--objects 13]

A step consists of forward pass, losses, backward pass and Adam, at the paper's size
(configs/paper/bedroom.yaml: width 512, 13 objects, 22 classes; 20 views per room) on the CPU.

`theirs` projects the 2,562 vertices of an icosphere for every object, and computes boxes, matching
and losses room by room in a Python loop. Both variants use this package's decoder, losses and
optimiser, and `theirs` runs the backward pass room by room, which saves memory; both choices are in
its favour. `plain` is this package's step with the transformer of
tests/references/scene_decoder.py, made of plain layers. `products_s` is the time that the step's
matrix products alone would take at the rate of a large product. The variants alternate, so that
other load affects all; values are medians. On a busy machine, rely on CPU time with one thread
(OMP_NUM_THREADS=1).
"""

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, TypeVar
from unittest import mock

import torch
from harness import machine, medians, report
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from sceneprior.apps.config import load_config
from sceneprior.core.cameras import MIN_DEPTH_M, Boxes2D, project
from sceneprior.core.proxies import icosphere, place
from sceneprior.core.views import DecodedScenes, SceneViews
from sceneprior.paper.config import PaperConfig
from sceneprior.paper.losses import layout_losses
from sceneprior.paper.matching import seen_boxes
from sceneprior.paper.prior import ScenePrior
from sceneprior.training.steps import weighted_sum

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from references.scene_decoder import unroll

SIZE = (480, 640)
CLASSES = 22
CONFIG = Path(__file__).parents[1] / "configs" / "paper/bedroom.yaml"
Batch = TypeVar("Batch", SceneViews, DecodedScenes)


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


def make_views(rooms: int, views: int, objects: int) -> SceneViews:
    """Synthetic observations: 2D boxes of random ellipsoids in all views."""
    centers, sizes, cameras, lens = make_batch(rooms, views, objects)
    with torch.no_grad():
        empty = DecodedScenes(
            centers.new_zeros(rooms, objects, CLASSES), centers, sizes,
            centers.new_zeros(rooms, objects),
        )  # fmt: skip
        blank = torch.zeros(rooms, views, objects, 4)
        frame = SceneViews(
            torch.arange(rooms), torch.zeros(rooms, objects, dtype=torch.long),
            torch.ones(rooms, objects, dtype=torch.bool), cameras, lens, blank,
            blank[..., 0].bool(), blank.bool(), SIZE,
        )  # fmt: skip
        seen = seen_boxes(empty, frame, "ellipsoid")
    generator = torch.Generator().manual_seed(1)
    classes = torch.randint(1, CLASSES, (rooms, objects), generator=generator)
    return replace(
        frame, object_class=classes, boxes=seen.boxes.clamp(0, 1), visible=seen.in_frustum,
        sides_clear=torch.ones_like(seen.boxes, dtype=torch.bool),
    )  # fmt: skip


def room(batch: Batch, index: int) -> Batch:
    """One room of a batch, as a batch."""
    values = {item.name: getattr(batch, item.name) for item in fields(batch)}
    part: dict[str, Any] = {
        name: v[index : index + 1] for name, v in values.items() if isinstance(v, Tensor)
    }
    return replace(batch, **part)


def our_step(prior: ScenePrior, z: Tensor, views: SceneViews, config: PaperConfig) -> None:
    scenes = prior.decode(z, with_shape=False)
    boxes = seen_boxes(scenes, views, "ellipsoid")
    losses, _ = layout_losses(scenes, boxes, views, config.loss, "first_n")
    weighted_sum(losses, config.loss).backward()


def plain_step(prior: ScenePrior, z: Tensor, views: SceneViews, config: PaperConfig) -> None:
    def forward(z: Tensor, objects: int, _: Tensor | None) -> Tensor:
        return unroll(prior.decoder, z, objects)

    with mock.patch.object(prior.decoder, "forward", forward):
        our_step(prior, z, views, config)


def their_boxes(points_m: Tensor, views: SceneViews) -> Boxes2D:
    """`boxes_of_points` with an autograd graph through every point."""
    height, width = views.image_size
    pixels = project(points_m, views.world_to_camera, views.intrinsics)
    size = pixels.new_tensor([width, height])
    low, high = pixels[..., :2].amin(dim=-2) / size, pixels[..., :2].amax(dim=-2) / size
    in_front = (pixels[..., 2] > MIN_DEPTH_M).any(dim=-1)
    meets_image = ((low < 1) & (high > 0)).all(dim=-1)
    return Boxes2D(torch.cat([low, high], dim=-1).clamp(0, 1), in_front & meets_image)


def their_step(prior: ScenePrior, z: Tensor, views: SceneViews, config: PaperConfig) -> None:
    scenes = prior.decode(z, with_shape=False)
    names = ("class_logits", "centers_m", "sizes_m", "completeness_logits")
    outputs = [getattr(scenes, name) for name in names]
    leaves = [output.detach().requires_grad_() for output in outputs]
    parted: dict[str, Any] = dict(zip(names, leaves, strict=True))
    loose = replace(scenes, **parted)
    sphere = icosphere(4)[0].expand(1, scenes.centers_m.shape[1], -1, -1)
    for index in range(len(z)):
        one, seen = room(loose, index), room(views, index)
        points = place(sphere, one.centers_m, one.sizes_m)
        boxes = their_boxes(points, seen)
        losses, _ = layout_losses(one, boxes, seen, config.loss, "first_n")
        (weighted_sum(losses, config.loss) / len(z)).backward()
    torch.autograd.backward(outputs, [leaf.grad for leaf in leaves])


Step = Callable[[ScenePrior, Tensor, SceneViews, PaperConfig], None]


def product_rate(repeats: int = 20) -> float:
    """Floating-point operations per second of a large matrix product: the fastest of several."""
    a, b = torch.randn(1456, 512), torch.randn(512, 1024)
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        a @ b
        seconds.append(time.process_time() - start)
    return 2 * a.numel() * b.shape[1] / min(seconds)


def step_ratio(
    rooms: int = 128, views: int = 20, objects: int = 13, repeats: int = 5
) -> dict[str, float]:
    """Median wall-clock and CPU seconds of all variants, and their ratios."""
    config = load_config(str(CONFIG), (f"model.max_objects={objects}",))
    assert isinstance(config, PaperConfig)
    batch = make_views(rooms, views, objects)
    prior = config.build_prior()
    logits = torch.randn(rooms, config.model.logits_per_room, requires_grad=True)
    optimizer = torch.optim.Adam([*prior.parameters(), logits], lr=1e-4, fused=True)

    def taken(step: Step) -> Callable[[], None]:
        def once() -> None:
            optimizer.zero_grad()
            step(prior, prior.latent_space(logits), batch, config)
            optimizer.step()

        return once

    steps = {"ours": our_step, "plain": plain_step, "theirs": their_step}
    calls = {name: taken(step) for name, step in steps.items()}
    clock, used = (medians(calls, repeats, by) for by in (time.perf_counter, time.process_time))
    with FlopCounterMode(display=False) as counter:
        our_step(prior, prior.latent_space(logits), batch, config)
    found = {"products_s": counter.get_total_flops() / product_rate()}
    for name in steps:
        found |= {f"{name}_s": clock[name], f"{name}_cpu_s": used[name]}
        found |= {f"{name}_ratio": clock[name] / clock["ours"]}
        found |= {f"{name}_ratio_cpu": used[name] / used["ours"]}
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rooms", type=int, default=128)
    parser.add_argument("--objects", type=int, default=13)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", type=Path, help="also write the numbers to this file")
    options = parser.parse_args()
    found = step_ratio(options.rooms, objects=options.objects, repeats=options.repeats)
    report(machine() | found, options.json)
