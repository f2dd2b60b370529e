"""All GPU benchmarks in one command of at most 40 minutes; a CPU suffices for a trial.

    python benchmarks/gpu.py [--out FOLDER] [--only PART ...]
    python benchmarks/gpu.py --tiny                  # a trial of all parts, in minutes
    python benchmarks/gpu.py --tiny --device cpu
    python benchmarks/gpu.py --brief --shards SHARDS --flat FLAT.npz    # some parts: six minutes

The parts compare kernels with the reference, and silhouettes with PyTorch3D and nvdiffrast if these
are installed. On procedural homes they train both stages of the paper's run
(`configs/paper/bedroom.yaml`), measure steps, memory, precision and two processes on one device,
and extrapolate the whole schedule.

Each part runs in a separate process with a time limit, so that a kernel that breaks the device's
context, or hangs, affects only that part. Rows are written as they are measured; a failure is a
row of the table. FOLDER/gpu.json and FOLDER/gpu.md (tables for docs/performance.md) are written
after every part; the output of each part is in FOLDER/parts.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, NamedTuple

import gpu_graphs
import gpu_parts
import gpu_sphere
import torch
from gpu_parts import BRIEF, PAPER, TINY, Setup, Sizes
from harness import machine


class Part(NamedTuple):
    """A part of the benchmark, with its time limit and title."""

    measure: Callable[[Setup], None]
    minutes: float
    title: str


PARTS = {
    "kernels": Part(gpu_parts.kernels, 3, "Silhouette kernels against the reference"),
    "homes": Part(gpu_parts.homes, 3, "Homes to train on"),
    "graphs": Part(gpu_graphs.graphs_part, 8, "The paper's run with CUDA graphs and without"),
    "schedule": Part(gpu_parts.schedule, 8, "The paper's run"),
    "speed": Part(gpu_parts.speed, 4, "Silhouettes"),
    "peers": Part(gpu_parts.peers, 2, "Silhouettes beside other renderers, one room"),
    "precision": Part(gpu_parts.precision, 8, "Precision"),
    "batches": Part(gpu_parts.batches, 5, "A larger batch"),
    "processes": Part(gpu_parts.processes, 7, "Two processes on one device"),
    "sphere": Part(gpu_sphere.sphere, 10, "The released network on 3,500 and on 534 rooms"),
}
"""The parts in order of importance; their limits add up to an hour."""
BRIEF_MINUTES = {"kernels": 0.8, "graphs": 4.2, "sphere": 2.5}
"""The parts of a run of six minutes, with their limits."""


def run(parts: dict[str, Part], out: Path, words: list[str]) -> dict[str, Any]:
    """Measure the parts one after the other, each in a separate process; returns the results.

    `words` are the options of this run that are passed on to the parts.
    """
    found: dict[str, Any] = {"machine": machine() | device_of(words), "commit": commit()}
    found["parts"] = {}
    end = time.monotonic()
    for name, part in parts.items():
        print(f"{name} ...", flush=True)
        start = time.monotonic()
        end += 60 * part.minutes  # later parts may use the time that earlier parts left
        problem = run_part(name, out, words, end - start)
        print(f"{name}: {time.monotonic() - start:.0f} s; {problem or 'done'}", flush=True)
        rows = out / "parts" / f"{name}.jsonl"
        lines = rows.read_text().splitlines() if rows.is_file() else []
        found["parts"][name] = {
            "title": part.title,
            "seconds": time.monotonic() - start,
            "rows": [json.loads(line) for line in lines],
            "failed": problem,
        }
        (out / "gpu.json").write_text(json.dumps(found, indent=2) + "\n")
        (out / "gpu.md").write_text(as_markdown(found))
    return found


def run_part(name: str, out: Path, words: list[str], seconds: float) -> str | None:
    """Run one part, for at most `seconds`; returns a line on its failure, or None."""
    folder = out / "parts"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.jsonl").unlink(missing_ok=True)
    log = folder / f"{name}.log"
    command = [sys.executable, "-u", __file__, *words, "--out", str(out), "--part", name]
    command += ["--until", f"{time.time() + seconds:.1f}"]
    with log.open("w") as said:
        # The child gets a new session, so that processes started by training can be killed with it.
        child = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            start_new_session=True,
        )  # fmt: skip
        repeats = threading.Thread(target=repeat, args=(child.stdout, said), daemon=True)
        repeats.start()
        try:
            status = child.wait(seconds)
        except subprocess.TimeoutExpired:
            return f"stopped after {seconds / 60:.1f} minutes; the rows were measured until then"
        finally:
            if child.poll() is None:
                os.killpg(child.pid, signal.SIGKILL)
                child.wait()
            repeats.join(5)
    if not status:
        return None
    lines = log.read_text().strip().splitlines() or [f"exit status {status}"]
    return lines[-1]


def repeat(lines: IO[str], said: IO[str]) -> None:
    """Print what a part prints, and write it to its log."""
    for line in lines:
        print(line, end="", flush=True)
        said.write(line)
        said.flush()


def measure(name: str, options: argparse.Namespace, sizes: Sizes, out: Path) -> None:
    """Measure one part, in the process of that part."""
    with (out / "parts" / f"{name}.jsonl").open("a") as file:

        def note(what: str, figures: dict[str, float]) -> None:
            file.write(json.dumps({"what": what, "figures": figures}) + "\n")
            file.flush()
            values = "; ".join(f"{key} {shown(value)}" for key, value in figures.items())
            print(f"* {what}: {values}", flush=True)

        given = options.shards, options.flat, options.until
        PARTS[name].measure(Setup(options.device, sizes, out, note, *given))


def as_markdown(found: dict[str, Any]) -> str:
    """One table per part, below a line on the machine and the commit."""
    about, lines = found["machine"], []
    lines.append(f"{about['device']}; {about['cores']} cores of {about['cpu']}; ")
    lines.append(f"torch {about['torch']}, CUDA {about['cuda']}; commit {found['commit']}.\n")
    for part in found["parts"].values():
        rows = part["rows"]
        columns = list(dict.fromkeys(name for row in rows for name in row["figures"]))
        lines.append(f"\n{part['title']} ({part['seconds']:.0f} s):\n\n")
        cells = [["what", *(name.replace("_", " ") for name in columns)]]
        cells.append(["---", *("---:" for _ in columns)])
        cells += [
            [row["what"], *(shown(row["figures"].get(name)) for name in columns)] for row in rows
        ]
        if part["failed"]:
            told = part["failed"].replace("|", "/")
            cells.append([f"**not measured to the end**: {told}", *("" for _ in columns)])
        lines += [f"| {' | '.join(row)} |\n" for row in cells]
    return "".join(lines)


def shown(value: float | None) -> str:
    """A value as text for a table."""
    if value is None:
        return ""
    return f"{value:,.0f}" if abs(value) >= 1000 or value == int(value) else f"{value:.3g}"


def device_of(words: list[str]) -> dict[str, Any]:
    """The GPU's name, and the CUDA version."""
    on_gpu = "cpu" not in words
    name = torch.cuda.get_device_name() if on_gpu else "no GPU (a trial on a CPU)"
    return {"device": name, "cuda": torch.version.cuda}


def commit() -> str:
    """The checkout's commit, followed by `+` if files have been changed."""
    folder = Path(__file__).parent
    git = ["git", "-C", str(folder), "describe", "--always", "--dirty=+", "--abbrev=10"]
    try:
        done = subprocess.run(git, capture_output=True, text=True)
    except OSError:  # no git there
        return "unknown"
    return done.stdout.strip() or "unknown"


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("out/gpu"))
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--tiny", action="store_true", help="small sizes, for a trial of minutes")
    parser.add_argument("--brief", action="store_true", help="some parts, in six minutes")
    parser.add_argument("--only", nargs="+", choices=PARTS)
    parser.add_argument("--shards", type=Path, help="shards to train on, instead of made homes")
    parser.add_argument("--flat", type=Path, help="views of many rooms, for the part `sphere`")
    parser.add_argument("--part", choices=PARTS, help=argparse.SUPPRESS)
    parser.add_argument("--until", type=float, default=0.0, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.device == "cuda" and not torch.cuda.is_available():
        parser.error("torch finds no GPU here; for a trial without one: --device cpu --tiny")
    out = options.out.absolute()
    if options.part:
        sizes = TINY if options.tiny else BRIEF if options.brief else PAPER
        measure(options.part, options, sizes, out)
        return
    parts = dict(PARTS)
    if options.brief:
        parts = {name: PARTS[name]._replace(minutes=most) for name, most in BRIEF_MINUTES.items()}
    words = ["--device", options.device]
    words += [f"--{name}" for name in ("tiny", "brief") if getattr(options, name)]
    for name in ("shards", "flat"):
        if (path := getattr(options, name)) is not None:
            words += [f"--{name}", str(path.absolute())]
    run({name: part for name, part in parts.items() if name in (options.only or parts)}, out, words)
    print((out / "gpu.md").read_text())


if __name__ == "__main__":
    main()
