"""Reconstruction from single views: 3D box IoU, and the time of one image alone and in a batch.

Run `python benchmarks/bench_reconstruct.py --run RUN --shards SHARDS`. Images are one view of each
test room. IoU is of axis-aligned boxes, every object of every image with the same weight; beside it
the training room nearest by masks, as `eval-svr` chooses it. The fit of latents as in the paper is
timed by a few steps (`--steps`), scaled to 1,000, without early stopping.

Processor time is what is compared: on a machine that others use, it says what wall time hides.
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

from sceneprior.config import load_run
from sceneprior.evaluation.ground_truth import reference_scenes
from sceneprior.evaluation.metrics.decoded_rooms import box_iou_3d
from sceneprior.offscreen import open_renderer
from sceneprior.reconstruction.fit import SCHEDULES, fit_latents
from sceneprior.reconstruction.image import ObservedImage, as_views, images_of_split
from sceneprior.reconstruction.known_rooms import known_rooms, nearest_answers
from sceneprior.reconstruction.reconstruct import FitOptions, reconstruct
from sceneprior.reconstruction.score import Answers
from sceneprior.training.method import TrainedPrior

FULL = SCHEDULES["paper"].steps


def cpu_seconds(what: Callable[[], object]) -> float:
    """Processor time of a call."""
    begin = time.process_time()
    what()
    return time.process_time() - begin


def fit_some(trained: TrainedPrior, images: list[ObservedImage], steps: int) -> None:
    """A few steps of the paper's fit, its start given."""
    views = as_views(images, trained.config.data.mask_step)
    schedule = replace(SCHEDULES["paper"], steps=steps, drop_at=steps, patience=0)
    start = trained.prior.latent_space(trained.logits[:1]).expand(len(images), -1)
    fit_latents(trained, views, start, schedule)


def mean_iou(images: list[ObservedImage], answers: Answers, shards: Path) -> float:
    """Over all objects of all images; 0 for what was not found."""
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
    parser.add_argument("--steps", type=int, default=4, help="of the fit of latents")
    parser.add_argument("--singles", type=int, default=4, help="images timed alone")
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    trained = load_run(given.run)
    images, _ = images_of_split(given.shards, "test", limit=given.images)
    # Evenly over the images by their number of objects, so that the few stand for all.
    ordered = sorted(images, key=lambda image: len(image.object_class))
    picked = ordered[:: max(1, len(images) // given.singles)]
    reconstruct(trained, picked[:1], FitOptions())
    fit_some(trained, picked[:1], 2)  # compiles the renderer
    scale = FULL / given.steps
    rows: dict[str, tuple[Callable[[list[ObservedImage]], object], float]] = {
        "object by object": (lambda some: reconstruct(trained, some, FitOptions()), 1.0),
        f"a latent, {FULL} steps": (lambda some: fit_some(trained, some, given.steps), scale),
    }
    print(f"{len(images)} images, {given.threads} threads, seconds of processor time an image")
    for name, (way, times) in rows.items():
        alone = times * statistics.mean(cpu_seconds(partial(way, [image])) for image in picked)
        many = times * cpu_seconds(partial(way, images)) / len(images)
        print(f"{name:24s} alone {alone:7.2f}   in a batch {many:7.2f}   {alone / many:5.1f} x")
    found = [one.scene.objects for one in reconstruct(trained, images, FitOptions())]
    nearest = nearest_answers(known_rooms(given.shards), images, open_renderer("auto"))
    ours, known = (
        mean_iou(images, answers, given.shards)
        for answers in (found, [one.objects for one in nearest])
    )
    print(f"3D box IoU {ours:.3f}, nearest training room {known:.3f}: {ours / known:.2f} x")


if __name__ == "__main__":
    main()
