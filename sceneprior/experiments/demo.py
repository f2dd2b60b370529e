"""Nothing in; homes, shards, a trained prior, new rooms, scores and a page out.

Each step is a `sceneprior` command in a process of its own, so the commands on the page are the
ones that ran. Finished steps are noted in `steps.json` and not repeated.
"""

import json
import shlex
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil
import typer

from sceneprior.errors import InputError

SAMPLE_EVERY_S = 0.5
RESULTS = {
    "homes": "homes", "shards": "shards/index.json", "fit": "run/shape/final.ckpt",
    "scenes": "scenes/overview.png", "scores": "scores.json", "report": "report.html",
}  # fmt: skip
"""What each step leaves behind; a step whose result was deleted is done again."""


def run_demo(out: Path, config: str, rooms: int, count: int, renderer: str) -> None:
    """Run every step that is not done yet, then put time and memory beside the scores.

    Raises:
        InputError: a step failed; its own sentence stands above.
    """
    out.mkdir(parents=True, exist_ok=True)
    journal = out / "steps.json"
    done = json.loads(journal.read_text()) if journal.is_file() else {}
    steps = _steps(out, config, rooms, count, renderer)
    for number, (name, arguments) in enumerate(steps.items()):
        before = done.get(name, {})
        same = before.get("arguments") == arguments and (out / RESULTS[name]).exists()
        if same and before["finished"]:
            typer.echo(f"{name}: done before, {done[name]['seconds']:.0f} s", err=True)
            continue
        for later in list(steps)[number + 1 :]:
            done.pop(later, None)  # what they left is of what lay here before
        typer.echo(f"$ sceneprior {shlex.join(arguments)}", err=True)
        told: list[str] = []
        if name == "report":
            _add_costs(out / "scores.json", done)
            for step in done.values():
                told += ["--command", f"sceneprior {shlex.join(step['arguments'])}"]
        status, seconds, peak = _measure([*arguments, *told])
        if before.get("finished"):
            before = {}  # done again from the start; only a stopped step goes on
        done[name] = {
            "arguments": arguments,
            "seconds": seconds + before.get("seconds", 0.0),
            "peak_memory_gib": max(peak, before.get("peak_memory_gib", 0.0)),
            "finished": status == 0,
        }
        _write_json(journal, done)
        if status == 130:
            typer.echo("Stopped. The same command goes on from here.", err=True)
            raise typer.Exit(130)
        if status != 0:
            raise InputError(f"The demo stopped at '{name}'; mend that and run it again.")
    _add_costs(out / "scores.json", done)
    typer.echo(f"Open {out / 'report.html'}; figures are in {out / 'scores.json'}.")


def _steps(out: Path, config: str, rooms: int, count: int, renderer: str) -> dict[str, list[str]]:
    homes, shards, run, scenes = (str(out / name) for name in ("homes", "shards", "run", "scenes"))
    draw = ["--renderer", renderer]
    return {
        "homes": ["make-homes", homes, "--rooms", str(rooms), "--seed", "0"],
        "shards": [
            "prep-front", "--front", f"{homes}/3D-FRONT", "--future", f"{homes}/3D-FUTURE-model",
            "--splits", f"{homes}/splits/bedroom.csv", "--room-type", "bedroom",
            "--out", shards, *draw,
        ],
        "fit": [
            "fit", "--config", config, "--run", run, "--set", f"data.shards={shards}", "--resume",
        ],
        "scenes": ["synthesize", "--run", run, "-n", "16", "--out", scenes, "--overwrite", *draw],
        "scores": [
            "eval-fid", "--run", run, "-n", str(count), "--out", str(out / "scores.json"), *draw,
        ],
        "report": [
            "report", "--run", run, "--scores", str(out / "scores.json"),
            "--out", str(out / "report.html"), *draw,
        ],
    }  # fmt: skip


def _measure(arguments: list[str]) -> tuple[int, float, float]:
    """Exit status, seconds, and peak memory in GiB of a command with all its workers."""
    start = time.monotonic()
    process = subprocess.Popen([sys.executable, "-m", "sceneprior", *arguments])
    over = threading.Event()
    peak = [0]

    def watch() -> None:
        while not over.wait(SAMPLE_EVERY_S):
            peak[0] = max(peak[0], _resident_bytes(process.pid))

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        status = process.wait()
    except KeyboardInterrupt:
        # The terminal has told the child too: let it save.
        process.wait()
        status = 130
    over.set()
    watcher.join()
    return status, time.monotonic() - start, peak[0] / 2**30


def _resident_bytes(pid: int) -> int:
    total = 0
    try:
        parent = psutil.Process(pid)
        for process in [parent, *parent.children(recursive=True)]:
            try:
                total += process.memory_info().rss
            except psutil.NoSuchProcess:
                continue
    except psutil.NoSuchProcess:
        return total
    return total


def _add_costs(scores: Path, done: dict[str, dict]) -> None:
    figures = json.loads(scores.read_text())
    figures["seconds"] = round(sum(step["seconds"] for step in done.values()), 1)
    figures["peak_memory_gib"] = round(max(step["peak_memory_gib"] for step in done.values()), 2)
    figures["steps"] = {name: round(step["seconds"], 1) for name, step in done.items()}
    _write_json(scores, figures)


def _write_json(path: Path, data: dict) -> None:
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(data, indent=2) + "\n")
    part.replace(path)
