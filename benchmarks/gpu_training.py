"""The paper's run on a device: steps, memory, precision, the whole schedule, two processes at once;
parts of `gpu.py`. All train on the made homes that the first of them prepares."""

import os
import tempfile
import time
from pathlib import Path

from bench_processes import compare
from gpu_setup import Setup
from timed_fit import CONFIG, StageTimes, made_shards, paper_run, timed_fit

from sceneprior.config import load_config
from sceneprior.experiments.evaluate_samples import SampleEvaluator
from sceneprior.settings import find_config
from sceneprior.training.method import Trained
from sceneprior.training.monitor import EvaluationResult

PAPER_ROOMS = 3530
"""Training bedrooms of the paper: nine in ten of 3,922."""
PRECISIONS = {
    "float32": ("32-true", "highest"),
    "TF32, as `fit` does": ("32-true", "high"),
    "bf16-mixed, TF32 beside it": ("bf16-mixed", "high"),
}


def homes(setup: Setup) -> None:
    """Made homes and their shards, which takes CPUs alone."""
    start = time.perf_counter()
    made_shards(setup.folder, setup.sizes.homes, len(os.sched_getaffinity(0)))
    seconds = time.perf_counter() - start
    setup.note("homes made and prepared", {"homes": setup.sizes.homes, "seconds": seconds})


def schedule(setup: Setup) -> None:
    """The paper's run, its samples evaluated at each stage's end; from it, the whole schedule."""
    whole = load_config(str(find_config(CONFIG)))
    epochs = {stage.name: stage.settings.epochs for stage in whole.stages()}
    config = paper_run(_shards(setup), setup.sizes.epochs, *_changes(setup, setup.sizes.rooms))
    evaluator = SampleEvaluator(config)
    hours: dict[str, float] = {}
    spent_s: list[float] = []

    def evaluate(trained: Trained) -> EvaluationResult:
        start = time.perf_counter()
        result = evaluator(trained)
        spent_s.append(time.perf_counter() - start)
        return result

    def ended(stage: str, times: StageTimes) -> None:
        hours[stage] = whole_epochs_s(times, epochs[stage], whole.data.rotations) / 3600
        what = f"{stage} stage; whole: {epochs[stage]} epochs"
        setup.note(what, times.figures() | {"whole_h": hours[stage]})

    with tempfile.TemporaryDirectory() as name:
        options = {"accelerator": setup.device, "devices": 1}
        timed_fit(config, Path(name) / "run", options, evaluate=evaluate, ended=ended)
    count = sum(each // whole.samples.every for each in epochs.values())
    hours["samples"] = count * max(spent_s) / 3600
    setup.note(
        f"{count} evaluations of {config.samples.count} samples", {"whole_h": hours["samples"]}
    )
    what = f"all of {CONFIG} on {PAPER_ROOMS:,} rooms, extrapolated"
    setup.note(what, {"whole_h": sum(hours.values())})


def whole_epochs_s(times: StageTimes, epochs: int, rotations: int) -> float:
    """Seconds of so many epochs on the paper's rooms: each row takes what it took here."""
    return epochs * times.epoch_s * PAPER_ROOMS * rotations / times.rooms


def batches(setup: Setup) -> None:
    """The same steps with more rooms a batch."""
    batch = setup.sizes.large_batch
    _time(setup, f"{batch} rooms a batch", "32-true", "high", batch)


def precision(setup: Setup) -> None:
    """Both stages in each precision."""
    for name, (bits, matmul) in PRECISIONS.items():
        _time(setup, name, bits, matmul, setup.sizes.rooms)


def _time(setup: Setup, what: str, bits: str, matmul: str, batch: int) -> None:
    def ended(stage: str, times: StageTimes) -> None:
        setup.note(f"{stage} stage, {what}", times.figures())

    config = paper_run(_shards(setup), setup.sizes.epochs, *_changes(setup, batch))
    options = {"accelerator": setup.device, "devices": 1, "precision": bits}
    with tempfile.TemporaryDirectory() as name:
        timed_fit(config, Path(name) / "run", options, matmul, ended=ended)


def processes(setup: Setup) -> None:
    """Two processes that share batches, and the device, against one."""
    shards, sizes = _shards(setup), setup.sizes
    with tempfile.TemporaryDirectory() as name:
        changes = _changes(setup, sizes.rooms)
        found = compare(shards, Path(name), setup.device, sizes.epochs, 1, changes)
    for stage, figures in found.items():
        setup.note(f"{stage} stage", figures)


def _shards(setup: Setup) -> Path:
    return made_shards(setup.folder, setup.sizes.homes, len(os.sched_getaffinity(0))).absolute()


def _changes(setup: Setup, batch: int) -> tuple[str, ...]:
    return (*setup.sizes.changes, f"layout.batch_size={batch}", f"shape.batch_size={batch}")
