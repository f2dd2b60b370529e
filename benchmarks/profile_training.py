"""Profile of training steps: time spent in each part of a step, for each stage of a run.

    python benchmarks/profile_training.py [CONFIG ...] [--threads 1 2] [--steps 20] [--shards DIR]

The script trains a few steps of every stage of shipped configs by `fit`, with their batch sizes, on
64 bedrooms that are made and prepared first, unless `--shards` is given. Lifting before the first
stage takes minutes, once per folder. Values are medians in milliseconds over the steps, except the
first, in which kernels compile: CPU time of all threads, which other load affects little, and wall
clock of the whole step. `rest` is the time outside all parts below: latents, the end of an epoch
with its checkpoint and logs, and Lightning itself.
"""

import argparse
import itertools
import platform
import statistics
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numba
import torch
from lightning.pytorch.profilers import Profiler
from timed_fit import made_shards

from sceneprior.apps.config import load_config
from sceneprior.lifted import stages as lifted_stages
from sceneprior.lifted.sampler import stage as sampler_stage
from sceneprior.paper import stages, view_loss
from sceneprior.paper.prior import ScenePrior
from sceneprior.training.fit import fit

CONFIGS = ("paper/bedroom_small.yaml", "lifted/bedroom.yaml", "bedroom.yaml")
ROOMS = 91  # 64 of them to train on
WARM_UP = 5
PARTS = {
    "decode": ((ScenePrior, "decode"),),
    "projection": ((stages, "proxy_boxes"), (view_loss, "proxy_boxes"), (stages, "seen_boxes")),
    "matching": ((view_loss, "match_objects"), (lifted_stages, "match_lifted")),
    "silhouettes": ((stages, "seen_masks"),),
    "loss": (
        (view_loss, "layout_losses"), (stages, "mask_loss"), (lifted_stages, "lifted_losses"),
        (lifted_stages, "shape_code_loss"), (sampler_stage, "negative_log_likelihood"),
    ),
}  # fmt: skip
"""The functions of each part of a step, each with the module or class in which it is patched."""
LIGHTNING = {
    "train_dataloader_next": "data", ".backward": "backward", ".optimizer_step": "optimiser",
}  # fmt: skip
"""Suffixes of names of Lightning's actions, each with the part that its time is added to."""
SHOWN = ("data", *PARTS, "backward", "optimiser", "rest")


class StepProfiler(Profiler):
    """CPU seconds of each part of each step; the time of nested parts goes to the inner one."""

    def __init__(self) -> None:
        super().__init__()
        self.stages: list[list[dict[str, float]]] = []
        self._parts = ["rest"]
        self._step: dict[str, float] = defaultdict(float)
        self._cpu, self._clock = time.process_time(), time.perf_counter()

    def setup(self, *arguments: Any, **options: Any) -> None:
        """Begin a stage."""
        super().setup(*arguments, **options)
        self.stages.append([])

    def start(self, action_name: str) -> None:
        self._charge()
        known = (part for end, part in LIGHTNING.items() if action_name.endswith(end))
        # The optimiser's action contains the closure that runs the whole step.
        around = "rest" if action_name.endswith(".training_step") else self._parts[-1]
        self._parts.append(action_name if action_name in PARTS else next(known, around))

    def stop(self, action_name: str) -> None:
        self._charge()
        self._parts.pop()
        if action_name == "run_training_batch":
            now = time.perf_counter()
            self._step["clock"] = now - self._clock
            self.stages[-1].append(self._step)
            self._step, self._clock = defaultdict(float), now

    def _charge(self) -> None:
        now = time.process_time()
        self._step[self._parts[-1]] += now - self._cpu
        self._cpu = now


@contextmanager
def watched(profiler: StepProfiler) -> Iterator[None]:
    """Patch the functions of `PARTS` to report to the profiler."""

    def timed(part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            with profiler.profile(part):
                return function(*arguments, **options)

        return call

    with ExitStack() as stack:
        for part, places in PARTS.items():
            for owner, name in places:
                call = timed(part, getattr(owner, name))
                stack.enter_context(mock.patch.object(owner, name, call))
        yield


def profile(name: str, shards: Path, run: Path, threads: int, steps: int) -> list[dict[str, float]]:
    """Train a few steps of each stage; returns the medians in ms by stage and part."""
    changes = [f"data.shards={shards}", "data.workers=0"]
    for stage in load_config(name).stages():
        # Train enough epochs of 64 rooms for all steps.
        epochs = -(-(steps + WARM_UP) // max(64 // stage.settings.batch_size, 1))
        changes += [f"{stage.name}.epochs={epochs}", f"{stage.name}.cpu_threads={threads}"]
    numba.config.NUMBA_NUM_THREADS = threads  # type: ignore[attr-defined]
    profiler = StepProfiler()
    with watched(profiler):
        fit(
            load_config(name, tuple(changes)),
            run,
            loggers=("csv",),
            trainer_options={"profiler": profiler},
        )
    return [medians_ms(stage[WARM_UP:]) for stage in profiler.stages]


def medians_ms(steps: list[dict[str, float]]) -> dict[str, float]:
    """Median ms per part, for all parts together (CPU), and by the wall clock."""
    found = {part: statistics.median(step[part] for step in steps) for part in SHOWN}
    found["CPU"] = statistics.median(sum(step.values()) - step["clock"] for step in steps)
    found["clock"] = statistics.median(step["clock"] for step in steps)
    return {part: 1000 * seconds for part, seconds in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("configs", nargs="*", default=CONFIGS, metavar="CONFIG")
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--shards", type=Path, help="prepared bedrooms (default: homes are made)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        shards = options.shards or made_shards(Path(name), ROOMS, workers=1)
        print(f"{platform.processor() or platform.machine()}, torch {torch.__version__}, ms a step")
        print("| stage | threads |", " | ".join(SHOWN), "| CPU | clock |")
        print("| --- |", " | ".join(["---:"] * (len(SHOWN) + 3)), "|")
        for config, threads in itertools.product(options.configs, options.threads):
            run = Path(name) / f"{Path(config).stem}-{threads}"
            stages_ = load_config(config).stage_names
            for stage, found in zip(
                stages_, profile(config, shards, run, threads, options.steps), strict=True
            ):
                cells = " | ".join(f"{value:.1f}" for value in found.values())
                print(f"| {Path(config).stem}: {stage} | {threads} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
