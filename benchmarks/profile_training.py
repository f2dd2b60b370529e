"""Where does the time of a training step go? Every stage of a run, part by part.

    python benchmarks/profile_training.py [CONFIG ...] [--threads 1 2] [--steps 20] [--shards DIR]

Trains a few steps of every stage of shipped configs by `fit`, in batches as large as theirs, on 64
bedrooms that are made and prepared first, unless `--shards` has some. Lifting before the first
stage takes minutes, once a folder. Milliseconds are medians over the steps, without the first
ones, in which kernels compile: CPU time of all threads, which other programs change little, and
the whole step by the clock. What no part below owns is `rest`: latents, the end of an epoch with
its checkpoint and logs, Lightning itself.
"""

import argparse
import itertools
import platform
import statistics
import subprocess
import sys
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

from sceneprior.config import load_config
from sceneprior.models.prior import ScenePrior
from sceneprior.sampler import stage as sampler_stage
from sceneprior.training import objective, stages
from sceneprior.training.fit import fit

CONFIGS = ("front_bedroom_small.yaml", "front_bedroom_large.yaml", "bedroom.yaml")
ROOMS = 91  # 64 of them to train on
WARM_UP = 5
PARTS = {
    "decode": ((ScenePrior, "decode"),),
    "projection": ((stages, "proxy_boxes"), (objective, "proxy_boxes"), (stages, "seen_boxes")),
    "matching": ((objective, "match_objects"), (stages, "match_lifted")),
    "silhouettes": ((stages, "seen_masks"),),
    "loss": (
        (objective, "layout_losses"), (stages, "mask_loss"), (stages, "lifted_losses"),
        (stages, "shape_code_loss"), (sampler_stage, "negative_log_likelihood"),
    ),
}  # fmt: skip
"""The functions of each part of a step, by the module or class that looks them up."""
LIGHTNING = {
    "train_dataloader_next": "data", ".backward": "backward", ".optimizer_step": "optimiser",
}  # fmt: skip
"""Ends of the names that Lightning gives to what it does, and our words for them."""
SHOWN = ("data", *PARTS, "backward", "optimiser", "rest")


class StepProfiler(Profiler):
    """CPU seconds of each part of each step; of parts within parts, the inner one has them."""

    def __init__(self) -> None:
        super().__init__()
        self.stages: list[list[dict[str, float]]] = []
        self._parts = ["rest"]
        self._step: dict[str, float] = defaultdict(float)
        self._cpu, self._clock = time.process_time(), time.perf_counter()

    def setup(self, *arguments: Any, **options: Any) -> None:
        """A stage begins."""
        super().setup(*arguments, **options)
        self.stages.append([])

    def start(self, action_name: str) -> None:
        self._charge()
        known = (part for end, part in LIGHTNING.items() if action_name.endswith(end))
        # The optimiser's action holds the closure that does all of the step.
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
    """Let the functions of `PARTS` tell the profiler."""

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


def make_shards(folder: Path) -> Path:
    """Bedrooms, made and prepared."""
    homes, shards = folder / "homes", folder / "shards"
    for words in (
        ["make-homes", homes, "--rooms", ROOMS],
        ["prep-front", "--front", homes / "3D-FRONT", "--future", homes / "3D-FUTURE-model",
         "--splits", homes / "splits" / "bedroom.csv", "--out", shards],
    ):  # fmt: skip
        subprocess.run([sys.executable, "-m", "sceneprior", *map(str, words)], check=True)
    return shards


def profile(name: str, shards: Path, run: Path, threads: int, steps: int) -> list[dict[str, float]]:
    """Train a few steps of each stage; each one's medians in ms."""
    changes = [f"data.shards={shards}", "data.workers=0", "samples.every=0"]
    for stage in load_config(name).stages():
        # An epoch of 64 rooms has at least so many steps.
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
    """The median of each part; last, all parts together and the clock."""
    found = {part: statistics.median(step[part] for step in steps) for part in SHOWN}
    found["CPU"] = statistics.median(sum(step.values()) - step["clock"] for step in steps)
    found["clock"] = statistics.median(step["clock"] for step in steps)
    return {part: 1000 * seconds for part, seconds in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("configs", nargs="*", default=CONFIGS, metavar="CONFIG")
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--shards", type=Path, help="prepared bedrooms; made here if not given")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        shards = options.shards or make_shards(Path(name))
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
