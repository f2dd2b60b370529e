"""Speed-up by a second training process: the paper's config with one and with two processes (DDP).

    python benchmarks/bench_processes.py [--set KEY=VALUE ...] [--json FILE]

Both stages are trained for a few epochs by `fit`, with one thread per process. Two processes share
each batch (`batch_size` is halved), so that both variants take the same steps and end with the same
weights; dropout, which differs between processes, is off. The variants alternate. Speed-ups are
medians of the ratios of neighbouring runs, in rooms per second and in steps. On a busy machine the
ratio of CPU seconds per process bounds the speed-up on idle cores. The bytes of gradients, which
are summed over processes at every step, and the seconds of this all-reduce are listed too.

With `--device cuda`, both processes share one GPU by gloo, since NCCL needs one GPU per process.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from harness import machine, report
from lightning.pytorch.strategies import DDPStrategy, StrategyRegistry
from timed_fit import made_shards, paper_run, timed_fit
from torch import distributed as dist

from sceneprior.training.callbacks import first_process
from sceneprior.training.method import read_checkpoint

STAGES = ("layout", "shape")


def compare(
    shards: Path, folder: Path, device: str, epochs: int, repeats: int, changes: tuple[str, ...]
) -> dict[str, dict[str, float]]:
    """Measurements of each stage; the runs are stored in `folder`."""
    runs: list[tuple[dict[str, Any], dict[str, Any]]] = []
    for repeat in range(repeats):
        one, two = (
            _child(shards, folder / f"{repeat}_{processes}", device, epochs, processes, changes)
            for processes in (1, 2)
        )
        runs.append((one, two))
    found = {}
    for stage in STAGES:
        rates = [[side[stage]["rooms_per_s"] for side in run] for run in runs]
        found[stage] = {
            "one_rooms_per_s": statistics.median(one for one, _ in rates),
            "two_rooms_per_s": statistics.median(two for _, two in rates),
            "two_over_one": statistics.median(two / one for one, two in rates),
            "two_over_one_in_steps": statistics.median(
                one[stage]["step_s"] / two[stage]["step_s"] for one, two in runs
            ),
            "bound_by_cpu_time": statistics.median(
                one[stage]["epoch_cpu_s"] / two[stage]["epoch_cpu_s"] for one, two in runs
            ),
            "weights_off": weights_off(folder / "0_1" / stage, folder / "0_2" / stage),
            **runs[0][1][stage]["bytes"],
            "all_reduce_s": statistics.median(run[1]["all_reduce_s"][stage] for run in runs),
            "all_reduce_of_4_bytes_s": statistics.median(run[1]["empty_s"] for run in runs),
        }
    return found


def weights_off(one: Path, two: Path) -> float:
    """The largest absolute difference between weights of two runs at the end of a stage."""
    ends = [read_checkpoint(path / "final.ckpt")["state_dict"] for path in (one, two)]
    return max(float((ends[0][name] - ends[1][name]).abs().max()) for name in ends[0])


def _child(
    shards: Path, run: Path, device: str, epochs: int, processes: int, changes: tuple[str, ...]
) -> dict[str, Any]:
    """Run `_train` in a child process, whose script Lightning restarts; returns its results."""
    words = ["--shards", shards, "--child", run, "--device", device, "--epochs", epochs]
    words += ["--processes", processes, *(word for item in changes for word in ("--set", item))]
    child = subprocess.run(
        [sys.executable, __file__, *map(str, words)],
        env=os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    if child.returncode:
        lines = child.stderr.strip().splitlines() or ["it printed nothing"]
        raise RuntimeError(f"{processes} training processes stopped: {lines[-1]}")
    return json.loads((run / "clock.json").read_text())


def _train(arguments: argparse.Namespace) -> None:
    """Train one run; executed in each of its processes."""
    processes, device = arguments.processes, torch.device(arguments.device)
    changes = ("model.decoder.dropout=0.0", "layout.cpu_threads=1", "shape.cpu_threads=1")
    config = paper_run(arguments.shards, arguments.epochs, *changes, *arguments.set)
    shared = [f"{stage}.batch_size={getattr(config, stage).batch_size // processes}"
              for stage in STAGES]  # fmt: skip
    config = paper_run(arguments.shards, arguments.epochs, *changes, *arguments.set, *shared)
    options: dict[str, Any] = {"accelerator": device.type, "devices": 1}
    if processes > 1:
        # The devices are set in the strategy, since Lightning would require one GPU per process.
        # The strategy is registered by name, so that each stage's trainer creates its own.
        places = [torch.device(device.type, 0) if device.type == "cuda" else device] * processes
        StrategyRegistry.register(
            "shared", DDPStrategy, parallel_devices=places, process_group_backend="gloo"
        )
        options["strategy"] = "shared"
    stages = timed_fit(config, arguments.child, options)
    found: dict[str, Any] = {}
    for name, times in stages.items():
        sizes = {"network_bytes": times.network_bytes, "latent_bytes": times.latent_bytes}
        found[name] = times.figures() | {"epoch_cpu_s": times.epoch_cpu_s, "bytes": sizes}
    if processes > 1:
        found["all_reduce_s"] = {
            name: _all_reduce_s(times.network_bytes + times.latent_bytes, device)
            for name, times in stages.items()
        }
        found["empty_s"] = _all_reduce_s(4, device)
    if first_process():
        (arguments.child / "clock.json").write_text(json.dumps(found))
    if processes > 1:
        dist.destroy_process_group()


def _all_reduce_s(size: int, device: torch.device, repeats: int = 20) -> float:
    """Median time in seconds to all-reduce `size` bytes of float32 over the processes."""
    numbers, times = torch.ones(size // 4, device=device), []
    for _ in range(repeats):
        dist.barrier()
        start = time.perf_counter()
        dist.all_reduce(numbers)
        if numbers.is_cuda:
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--shards", type=Path, help="view shards (default: homes are made)")
    parser.add_argument("--rooms", type=int, default=24, help="number of homes to make")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--epochs", type=int, default=4, help="epochs of each stage, at least 3")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--set", action="append", default=[], help="changed key, such as shape.silhouettes=fast"
    )
    parser.add_argument("--json", type=Path, help="also write the numbers to this file")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--processes", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        _train(arguments)
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shards = arguments.shards or made_shards(folder, arguments.rooms, os.cpu_count() or 1)
        found = compare(
            shards.absolute(), folder / "runs", arguments.device, arguments.epochs,
            arguments.repeats, tuple(arguments.set),
        )  # fmt: skip
    rows = {f"{stage} {name}": v for stage, part in found.items() for name, v in part.items()}
    report(machine() | rows, arguments.json)


if __name__ == "__main__":
    main()
