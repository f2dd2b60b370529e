"""Time reconstruction: one image, and many in a batch against one after the other.

Run `python benchmarks/bench_reconstruct.py --run RUN --shards SHARDS`. Images are one view of each
test room (training rooms after them, if there are too few). Few steps are timed (`--steps`) and
scaled to the schedule's 1,000, without early stopping: every step of a schedule costs the same. The
two ways take turns, round by round; numbers are medians.

Processor time is what is compared: on a machine that others use, it says what wall time hides.
`--threads 1` makes the two the same thing on an idle machine.
"""

import argparse
import statistics
import time
from dataclasses import replace
from pathlib import Path

import torch

from sceneprior.config import load_run
from sceneprior.reconstruction.fit import SCHEDULES, FitSchedule, fit_latents
from sceneprior.reconstruction.image import ObservedImage, as_views, images_of_split
from sceneprior.training.method import TrainedPrior

FULL = SCHEDULES["paper"].steps


def cpu_seconds(trained: TrainedPrior, images: list[ObservedImage], schedule: FitSchedule) -> float:
    """Processor time of fitting these images together, starts given."""
    views = as_views(images)
    start = trained.prior.latent_space(trained.logits[: len(images)])
    begin = time.process_time()
    fit_latents(trained, views, start, schedule)
    return time.process_time() - begin


def main() -> None:
    """Print seconds for 1,000 steps."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, required=True)
    parser.add_argument("--shards", type=Path, required=True)
    parser.add_argument("--images", type=int, default=32)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--singles", type=int, default=8, help="images fitted alone in a round")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    trained = load_run(given.run)
    images: list[ObservedImage] = []
    for split in ("test", "train"):
        if len(images) < given.images:
            images += images_of_split(given.shards, split, limit=given.images - len(images))[0]
    schedule = replace(SCHEDULES["paper"], steps=given.steps, drop_at=given.steps, patience=0)
    # Evenly over the images by their number of objects, so that the few stand for all.
    images.sort(key=lambda image: len(image.object_class))
    picked = images[:: max(1, len(images) // given.singles)]
    cpu_seconds(trained, images[:1], replace(schedule, steps=2))  # compiles the renderer
    alone, together = [], []
    for _ in range(given.rounds):
        alone.append(statistics.mean(cpu_seconds(trained, [image], schedule) for image in picked))
        together.append(cpu_seconds(trained, images, schedule) / len(images))
    scale = FULL / given.steps
    one, many = (statistics.median(times) * scale for times in (alone, together))
    objects = [len(image.object_class) for image in images]
    print(
        f"{len(images)} images of {min(objects)} to {max(objects)} objects, {given.threads} "
        f"threads; medians of {given.rounds} rounds of {given.steps} steps, scaled to {FULL}"
    )
    print(f"one image alone:            {one:7.1f} s of processor time")
    print(f"one of {len(images):3d} in a batch:     {many:7.1f} s")
    print(f"batch against one by one:   {one / many:7.1f} times as fast")


if __name__ == "__main__":
    main()
