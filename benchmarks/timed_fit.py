"""Timing of `fit`: a few epochs of a paper-sized run on procedural homes."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.callbacks import Callback

from data_prep.engine.build import Job, build_shards
from data_prep.front.recipe import load_recipe
from data_prep.front.source import FrontSource
from data_prep.homes.make import make_homes
from sceneprior.apps.config import load_config
from sceneprior.core.parallel import on_workers
from sceneprior.core.settings import find_config
from sceneprior.training.fit import fit
from sceneprior.training.method import RunConfig

CONFIG = "bedroom.yaml"
"""The paper's settings for bedrooms."""


def made_shards(folder: Path, rooms: int, workers: int) -> Path:
    """Shards of `rooms` procedural bedrooms, 70% of them for training."""
    shards, homes = folder / "shards", folder / "homes"
    if not (shards / "index.json").is_file():  # written last
        if not homes.is_dir():
            make_homes(homes, rooms, "bedroom", seed=0)
        front, future = homes / "3D-FRONT", homes / "3D-FUTURE-model"
        splits = homes / "splits" / "bedroom.csv"
        source = FrontSource(front, future, load_recipe("bedroom"), splits)
        with on_workers(workers):
            build_shards(Job(source, shards, renderer="software"))
    return shards


def paper_run(shards: Path, epochs: int, *changes: str) -> RunConfig:
    """The paper's run on other shards, with both stages cut to a few epochs."""
    short = (f"layout.epochs={epochs}", f"shape.epochs={epochs}")
    return load_config(str(find_config(CONFIG)), (f"data.shards={shards}", *short, *changes))


@dataclass
class StageTimes:
    """Measurements of a stage."""

    rooms: int = 0
    """Rows per epoch over all processes, turned copies included."""
    network_bytes: int = 0
    """Bytes of the network's gradients, which processes sum at each step."""
    latent_bytes: int = 0
    """Bytes of the latents' gradients, which processes sum at each step."""
    starts_s: list[float] = field(default_factory=list)
    """Start times of the epochs by the wall clock."""
    starts_cpu_s: list[float] = field(default_factory=list)
    """CPU seconds of the process at the starts of the epochs."""
    steps_s: list[list[float]] = field(default_factory=list)
    """Seconds of the steps, by epoch."""
    peak_mib: float = 0.0
    """Peak memory of tensors on the GPU; 0 on a CPU."""
    loss: float = 0.0
    """Loss of the last epoch."""

    @property
    def first_epoch_s(self) -> float:
        return self.starts_s[1] - self.starts_s[0]

    @property
    def epoch_s(self) -> float:
        """Median seconds of an epoch, without the first, which compiles and reads images, and
        without the last, which ends with the stage."""
        return _between(self.starts_s)

    @property
    def epoch_cpu_s(self) -> float:
        """Median CPU seconds of the epochs of `epoch_s` in this process, without its loaders."""
        return _between(self.starts_cpu_s)

    @property
    def step_s(self) -> float:
        """Median seconds of a step (loss, backward and update, without loading), in the epochs of
        `epoch_s`."""
        return statistics.median(step for epoch in self.steps_s[1:-1] for step in epoch)

    def figures(self) -> dict[str, float]:
        """The values of a table row, by name."""
        waiting = self.epoch_s - self.step_s * len(self.steps_s[1])
        return {
            "step_s": self.step_s,
            "epoch_s": self.epoch_s,
            "between_steps_s": waiting,
            "first_epoch_s": self.first_epoch_s,
            "rooms_per_s": self.rooms / self.epoch_s,
            "peak_mib": self.peak_mib,
            "loss": self.loss,
        }


StageEnded = Callable[[str, StageTimes], None]


class Clock(Callback):
    """Measures every step and epoch of each stage, separately in each process."""

    def __init__(self, matmul: str, ended: StageEnded) -> None:
        self.matmul, self.ended = matmul, ended
        self.stages: dict[str, StageTimes] = {}
        self._began = 0.0

    def on_train_start(self, trainer, pl_module) -> None:
        torch.set_float32_matmul_precision(self.matmul)  # overrides "high", which `fit` sets
        trained = {n: p.nbytes for n, p in pl_module.named_parameters() if p.requires_grad}
        latents = sum(size for name, size in trained.items() if name.startswith("latents."))
        self._now = StageTimes(
            len(trainer.train_dataloader.dataset), sum(trained.values()) - latents, latents
        )
        self._name = Path(trainer.default_root_dir).name
        self.stages[self._name] = self._now
        if torch.cuda.is_available():
            torch.cuda.reset_peak_memory_stats()

    def on_train_epoch_start(self, trainer, pl_module) -> None:
        self._now.starts_s.append(_now_s())
        self._now.starts_cpu_s.append(time.process_time())
        self._now.steps_s.append([])

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx) -> None:
        self._began = _now_s()

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx) -> None:
        self._now.steps_s[-1].append(_now_s() - self._began)

    def on_train_end(self, trainer, pl_module) -> None:
        self._now.loss = float(trainer.callback_metrics["train/loss"])
        if torch.cuda.is_available():
            self._now.peak_mib = torch.cuda.max_memory_allocated() / 2**20
        self.ended(self._name, self._now)


def _between(marks: list[float]) -> float:
    return statistics.median(end - start for start, end in pairwise(marks[1:]))


def _now_s() -> float:
    # Each step synchronises for its loss anyway (`check_finite`), so this changes little.
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


def timed_fit(
    config: RunConfig,
    run: Path,
    options: dict[str, Any],
    matmul: str = "high",
    ended: StageEnded = lambda name, times: None,
) -> dict[str, StageTimes]:
    """Train a run from its start, at least 3 epochs per stage; returns the times by stage.

    `matmul` is the precision of float32 matrix products: `high`, which `fit` uses, is TF32 on GPUs
    that have it; `highest` is float32. `ended` is called with each stage as soon as it ends, since
    the next one may exceed the device's memory.
    """
    clock = Clock(matmul, ended)
    fit(config, run, loggers=("csv",), trainer_options=options, callbacks=[clock])
    return clock.stages
