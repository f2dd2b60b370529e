"""The whole pipeline on procedural homes: homes, shards, training, new rooms, scores, a page.

The commands on the page are those that ran.
"""

import shlex
import sys
from pathlib import Path

from sceneprior.apps.config import load_config
from sceneprior.apps.experiments.commands import (
    Command,
    Main,
    is_done,
    read_journal,
    read_result,
    run_command,
    running_commands,
)
from sceneprior.core.errors import InputError
from sceneprior.core.files import write_json


def run_demo(out: Path, config: str, rooms: int, count: int, main: Main) -> None:
    """Run every unfinished command, then add time and memory to the scores.

    Ctrl-C, SIGTERM and SIGHUP raise KeyboardInterrupt; a second, identical call continues.
    """
    commands = demo_commands(out, config, rooms, count)
    with running_commands(out):
        for command in commands:
            if is_done(command, out):
                took = read_journal(out)[command.name]["wall_s"]
                seconds = "" if took is None else f", {took:.0f} s"
                print(f"{command.name}: done before{seconds}", file=sys.stderr)
                continue
            told: list[str] = []
            if command.name == "report":
                _add_costs(out)
                for earlier in commands[:-1]:
                    told += ["--command", f"sceneprior {shlex.join(earlier.arguments)}"]
            try:
                run_command(main, command, out, unshown=told)
            except InputError:
                raise InputError(
                    f"The demo stopped at '{command.name}'; fix the error and run it again."
                ) from None
        _add_costs(out)


def demo_commands(out: Path, config: str, rooms: int, count: int) -> list[Command]:
    """The demo's commands in order; a command is repeated if its arguments or the contents of
    `config` change."""
    homes, shards, run, scenes = (str(out / name) for name in ("homes", "shards", "run", "scenes"))
    scores, page = str(out / "scores.json"), str(out / "report.html")
    words = {
        "homes": ["make-homes", homes, "--rooms", str(rooms), "--seed", "0"],
        "shards": [
            "prep-front", "--front", f"{homes}/3D-FRONT", "--future", f"{homes}/3D-FUTURE-model",
            "--splits", f"{homes}/splits/bedroom.csv", "--recipe", "bedroom",
            "--out", shards,
        ],
        "fit": [
            "fit", "--config", config, "--run", run, "--set", f"data.shards={shards}", "--resume",
        ],
        "scenes": ["synthesize", "--run", run, "-n", "16", "--out", scenes, "--overwrite"],
        "scores": ["eval-fid", "--run", run, "-n", str(count), "--out", scores],
        "report": ["report", "--run", run, "--scores", scores, "--out", page],
    }  # fmt: skip
    settings = load_config(config)
    last = settings.stages()[-1].name
    results = {
        "homes": "homes", "shards": "shards/index.json", "fit": f"run/{last}/final.ckpt",
        "scenes": "scenes/overview.png", "scores": "scores.json", "report": "report.html",
    }  # fmt: skip
    continues = {"shards": out / "shards", "fit": out / "run"}
    depends_on = words | {"fit": [*words["fit"], settings.model_dump_json()]}
    return [
        Command(name, arguments, out / results[name], depends_on[name], continues.get(name))
        for name, arguments in words.items()
    ]


def _add_costs(out: Path) -> None:
    """Add the time and memory of all commands to scores.json, unless one was killed."""
    noted = {name: entry for name, entry in read_journal(out).items() if entry.get("finished")}
    scores = read_result(out / "scores.json")
    seconds = {name: entry["wall_s"] for name, entry in noted.items()}
    if None not in seconds.values():
        scores["seconds"] = round(sum(seconds.values()), 1)
        scores["peak_memory_gib"] = round(max(e["peak_memory_gib"] for e in noted.values()), 2)
        scores["steps"] = {name: round(took, 1) for name, took in seconds.items()}
    write_json(out / "scores.json", scores)
