"""Speed of two torch threads against one, on an idle machine and with another core in use.

Run `python benchmarks/bench_threads.py`. It measures the wall clock of a layout step of the small
configs' size (64 rooms) and of the paper's size (32 rooms), each setting in a separate process. The
settings alternate step by step, so that other load affects all; values are medians.
"""

import argparse
import os
import platform
import statistics
import subprocess
import sys
import time

SIZES = {"paper/bedroom_small.yaml": 64, "bedroom.yaml": 32}
SETTINGS: dict[str, tuple[int, dict[str, str]]] = {
    "one thread": (1, {}),
    "two": (2, {}),
    "two, spinning": (2, {"GOMP_SPINCOUNT": "300000"}),  # libgomp's default
}
BURN = "while True: pass"


def answer_steps(config_name: str, threads: int) -> None:
    """Time one step for every line on standard input."""
    from sceneprior.apps.config import load_config
    from sceneprior.paper.config import PaperConfig  # before torch, which starts OpenMP

    import torch  # isort: skip
    from bench_layout_step import make_views, our_step

    torch.set_num_threads(threads)
    rooms = SIZES[config_name]
    config = load_config(config_name, ("label_set=front3d_bedroom",))
    assert isinstance(config, PaperConfig)
    views, prior = make_views(rooms, 20, config.model.max_objects), config.build_prior()
    logits = torch.randn(rooms, config.model.logits_per_room, requires_grad=True)
    optimizer = torch.optim.Adam([*prior.parameters(), logits], lr=1e-4, fused=True)
    for _ in sys.stdin:
        optimizer.zero_grad()
        begin = time.perf_counter()
        our_step(prior, prior.latent_space(logits), views, config)
        optimizer.step()
        print(time.perf_counter() - begin, flush=True)


def step_seconds(process: "subprocess.Popen[str]") -> float:
    """Let a process run one step; returns its seconds."""
    asked, answered = process.stdin, process.stdout
    assert asked is not None and answered is not None
    asked.write("step\n")
    asked.flush()
    return float(answered.readline())


def measure(config_name: str, burn: bool, repeats: int) -> dict[str, float]:
    """Median seconds per step of each setting."""
    processes = {
        name: subprocess.Popen(
            [sys.executable, __file__, "--answer", config_name, str(threads)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env={**os.environ, **more},
        )
        for name, (threads, more) in SETTINGS.items()
    }  # fmt: skip
    for process in processes.values():
        step_seconds(process)
    other = [subprocess.Popen([sys.executable, "-c", BURN], text=True)] if burn else []
    try:
        times = [
            {name: step_seconds(process) for name, process in processes.items()}
            for _ in range(repeats)
        ]
    finally:
        for process in (*processes.values(), *other):
            process.kill()
    return {name: statistics.median(row[name] for row in times) for name in processes}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--repeats", type=int, default=11)
    parser.add_argument("--answer", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.answer:
        answer_steps(options.answer[0], int(options.answer[1]))
        return
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores")
    for name in SIZES:
        for burn in (False, True):
            found = measure(name, burn, options.repeats)
            first = found["one thread"]
            said = ", ".join(f"{k} {v:.3f} s ({v / first:.2f})" for k, v in found.items())
            print(f"{name}, {'a core burning' if burn else 'alone'}: {said}", flush=True)


if __name__ == "__main__":
    main()
