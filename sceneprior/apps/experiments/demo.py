"""The whole pipeline on procedural homes: homes, shards, training, new rooms, scores, a page.

Each step is a `sceneprior` command, so the commands on the page are the ones that ran.
"""

import shlex
import sys
from pathlib import Path

from sceneprior.apps.config import load_config
from sceneprior.apps.experiments.steps import Step, is_done, open_runner, read_journal, read_result
from sceneprior.core.errors import InputError
from sceneprior.core.files import write_json


def run_demo(out: Path, config: str, rooms: int, count: int) -> None:
    """Run every unfinished step, then add time and memory to the scores.

    Ctrl-C, SIGTERM and SIGHUP raise KeyboardInterrupt; a second, identical call continues.
    """
    steps = demo_steps(out, config, rooms, count)
    with open_runner(out) as runner:
        for step in steps:
            if is_done(step, out):
                took = read_journal(out)[step.name]["wall_s"]
                seconds = "" if took is None else f", {took:.0f} s"
                print(f"{step.name}: done before{seconds}", file=sys.stderr)
                continue
            told: list[str] = []
            if step.name == "report":
                _add_costs(out)
                for earlier in steps[:-1]:
                    told += ["--command", f"sceneprior {shlex.join(earlier.arguments)}"]
            try:
                runner.do(step, out, unshown=told)
            except InputError:
                raise InputError(
                    f"The demo stopped at '{step.name}'; fix the error and run it again."
                ) from None
        _add_costs(out)


def demo_steps(out: Path, config: str, rooms: int, count: int) -> list[Step]:
    """The demo's commands in order; a command is repeated if its arguments or the contents of
    `config` change."""
    homes, shards, run, scenes = (str(out / name) for name in ("homes", "shards", "run", "scenes"))
    scores, page = str(out / "scores.json"), str(out / "report.html")
    commands = {
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
    depends_on = commands | {"fit": [*commands["fit"], settings.model_dump_json()]}
    return [
        Step(name, words, out / results[name], depends_on[name], continues.get(name))
        for name, words in commands.items()
    ]


def _add_costs(out: Path) -> None:
    """Add the time and memory of all steps to scores.json, unless a step was killed."""
    noted = {name: entry for name, entry in read_journal(out).items() if entry.get("finished")}
    scores = read_result(out / "scores.json")
    seconds = {name: entry["wall_s"] for name, entry in noted.items()}
    if None not in seconds.values():
        scores["seconds"] = round(sum(seconds.values()), 1)
        scores["peak_memory_gib"] = round(max(e["peak_memory_gib"] for e in noted.values()), 2)
        scores["steps"] = {name: round(took, 1) for name, took in seconds.items()}
    write_json(out / "scores.json", scores)
