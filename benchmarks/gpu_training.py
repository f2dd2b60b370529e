"""Training benchmarks of `gpu.py`: steps, memory, precision, full schedule and two processes.

All parts train the paper's run on the procedural homes that the part `homes` prepares.
"""

import os
import tempfile
import time
from pathlib import Path

from bench_processes import compare
from gpu_setup import Setup
from timed_fit import CONFIG, StageTimes, made_shards, paper_run, timed_fit

from sceneprior.apps.config import load_config
from sceneprior.core.settings import find_config

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
    config = paper_run(_shards(setup), setup.sizes.epochs, *_changes(setup, setup.sizes.rooms))
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

    config = paper_run(_shards(setup), setup.sizes.epochs, *_changes(setup, batch))
    options = {"accelerator": setup.device, "devices": 1, "precision": bits}
    with tempfile.TemporaryDirectory() as name:
        timed_fit(config, Path(name) / "run", options, matmul, ended=ended)


def processes(setup: Setup) -> None:
    """Compare two processes, which share each batch and the device, with one."""
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
