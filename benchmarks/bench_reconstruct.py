"""Single-view reconstruction: 3D box IoU, and time per image, alone and in a batch.

Run `python benchmarks/bench_reconstruct.py --run RUN --shards SHARDS`. The images are one view of
each test room. The IoU is of axis-aligned boxes, with the same weight for every object; the
baseline is the training room nearest by masks, as in `eval-svr`. The paper's latent fit is timed
over a few steps (`--steps`) and scaled to 1,000, without early stopping.

CPU time is compared, since wall time depends on the machine's other load.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from sceneprior.apps.config import load_run
from sceneprior.apps.reconstruction.reconstruct import FitOptions, reconstruct
from sceneprior.apps.reconstruction.score import Answers
from sceneprior.core.ground_truth import reference_scenes
from sceneprior.core.observed_image import ObservedImage, as_views, images_of_split
from sceneprior.core.overlaps import box_iou_3d
from sceneprior.lifted.reconstruction.known_rooms import known_rooms, nearest_answers
from sceneprior.paper.fit_image import SCHEDULES, fit_latents_to_images
from sceneprior.paper.prior import TrainedPrior
from sceneprior.render.offscreen import SoftwareRenderer

FULL = SCHEDULES["paper"].steps


def cpu_seconds(what: Callable[[], object]) -> float:
    """CPU seconds of a call."""
    begin = time.process_time()
    what()
    return time.process_time() - begin


def fit_some(trained: TrainedPrior, images: list[ObservedImage], steps: int) -> None:
    """Run a few steps of the paper's fit, from a given start."""
    views = as_views(images, trained.config.data.mask_step)
    schedule = replace(SCHEDULES["paper"], steps=steps, drop_at=steps, patience=0)
    start = trained.prior.latent_space(trained.logits[:1]).expand(len(images), -1)
    fit_latents_to_images(trained, views, start, schedule)


def mean_iou(images: list[ObservedImage], answers: Answers, shards: Path) -> float:
    """Mean 3D box IoU over all objects of all images; an object that is not found counts as 0."""
    rooms = reference_scenes(shards, "test", tracked_only=True, meshes=False)
    truth = {scene.name: scene.objects for scene in rooms}
    ious = []
    for image, objects in zip(images, answers, strict=True):
        for row, found in zip(image.rows, objects, strict=True):
            true = truth[image.room_id][row]
            boxes = [
                np.array([values])
                for item in (true, found or true)
                for values in (item.center_m, item.size_m)
            ]
            ious.append(0.0 if found is None else float(box_iou_3d(*boxes)[0, 0]))
    return statistics.mean(ious)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, required=True)
    parser.add_argument("--shards", type=Path, required=True)
    parser.add_argument("--images", type=int, default=32)
    parser.add_argument("--steps", type=int, default=4, help="steps of the latent fit")
    parser.add_argument("--singles", type=int, default=4, help="images timed alone")
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    trained = load_run(given.run)
    images, _ = images_of_split(given.shards, "test", limit=given.images)
    # Take a sample that is spread evenly over the numbers of objects.
    ordered = sorted(images, key=lambda image: len(image.object_class))
    picked = ordered[:: max(1, len(images) // given.singles)]
    reconstruct(trained, picked[:1], FitOptions())
    fit_some(trained, picked[:1], 2)  # compiles the renderer
    scale = FULL / given.steps
    rows: dict[str, tuple[Callable[[list[ObservedImage]], object], float]] = {
        "object by object": (lambda some: reconstruct(trained, some, FitOptions()), 1.0),
        f"a latent, {FULL} steps": (lambda some: fit_some(trained, some, given.steps), scale),
    }
    print(f"{len(images)} images, {given.threads} threads, CPU seconds per image")
    for name, (way, times) in rows.items():
        alone = times * statistics.mean(cpu_seconds(partial(way, [image])) for image in picked)
        many = times * cpu_seconds(partial(way, images)) / len(images)
        print(f"{name:24s} alone {alone:7.2f}   in a batch {many:7.2f}   {alone / many:5.1f} x")
    found = [one.scene.objects for one in reconstruct(trained, images, FitOptions())]
    nearest = nearest_answers(known_rooms(given.shards), images, SoftwareRenderer())
    ours, known = (
        mean_iou(images, answers, given.shards)
        for answers in (found, [one.objects for one in nearest])
    )
    print(f"3D box IoU {ours:.3f}, nearest training room {known:.3f}: {ours / known:.2f} x")


if __name__ == "__main__":
    main()
