"""Steps of the demo that are repeated after a change; commands are replaced by ones that only write
their results."""

import json
from pathlib import Path

import pytest

from sceneprior.apps.experiments import commands
from sceneprior.apps.experiments.commands import demo_commands, finished_commands, run_demo
from sceneprior.core.errors import InputError
from sceneprior.core.settings import apply_override

SETTINGS = ("demo.yaml", 20, 4)
COMMANDS = ["make-homes", "prep-front", "fit", "synthesize", "eval-fid", "report"]


@pytest.fixture
def ran(tmp_path, monkeypatch):
    """Arguments of the commands that were called, and their exit status by command."""
    called: list[list[str]] = []
    status: dict[str, int] = {}
    results = {step.arguments[0]: step.result for step in demo_commands(tmp_path, *SETTINGS)}

    def call(main, arguments, log):
        assert log is None  # progress goes to the terminal
        called.append(arguments)
        if not status.get(arguments[0]):
            path = results[arguments[0]]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps({"protocol": {}}))
        clock["wall_s"] += 2.0
        if status.get(arguments[0]):
            raise InputError("no.")

    clock = {"cpu_s": 3.0, "wall_s": 0.0}
    monkeypatch.setattr(commands, "call", call)
    monkeypatch.setattr(commands, "costs", clock.copy)
    return called, status


def run(out: Path, called: list[list[str]], **changes) -> list[str]:
    called.clear()
    run_demo(out, *(SETTINGS if not changes else changes["settings"]), main=int)
    return [arguments[0] for arguments in called]


def test_finished_steps_are_not_repeated_and_their_costs_are_scores(ran, tmp_path, capsys):
    assert run(tmp_path, ran[0]) == COMMANDS
    said = capsys.readouterr().err
    assert said.splitlines()[0] == f"$ sceneprior make-homes {tmp_path}/homes --rooms 20 --seed 0"
    assert run(tmp_path, ran[0]) == []
    assert "fit: done before, 2 s\n" in capsys.readouterr().err
    told, seconds = finished_commands(tmp_path)
    assert [command.split()[1] for command in told] == COMMANDS and seconds == 12.0


@pytest.mark.parametrize("name", ["my #1", "a: b"])
def test_folders_of_any_name_are_read_as_they_are(name):
    (fit,) = (step for step in demo_commands(Path(name), *SETTINGS) if step.name == "fit")
    data = {}
    apply_override(data, fit.arguments[fit.arguments.index("--set") + 1])
    assert data == {"data": {"shards": f"{name}/shards"}}


def test_what_follows_a_step_that_is_done_again_is_done_again(ran, tmp_path):
    called, status = ran
    run(tmp_path, called)
    (tmp_path / "run" / "sampler" / "final.ckpt").unlink()
    status["synthesize"] = 2
    with pytest.raises(InputError, match="The demo stopped at 'scenes'"):
        run(tmp_path, called)
    status.clear()
    # Scores of the former prior are there, and are not taken for the new one's.
    assert run(tmp_path, called) == ["synthesize", "eval-fid", "report"]
    assert run(tmp_path, called) == []
    assert run(tmp_path, called, settings=("demo.yaml", 20, 5)) == ["eval-fid", "report"]


def test_costs_add_up_over_a_stop_and_are_unknown_after_a_kill(ran, tmp_path):
    called, status = ran

    def wall_s():
        return json.loads((tmp_path / "steps.json").read_text())["fit"].get("wall_s")

    (tmp_path / "run").mkdir()  # begun, but not by the demo: nobody knows what that took
    status["fit"] = 2
    with pytest.raises(
        InputError, match="The demo stopped at 'fit'; fix the error and run it again"
    ):
        run(tmp_path, called)
    assert wall_s() is None
    (tmp_path / "run").rmdir()
    for total in (2.0, 4.0):
        with pytest.raises(InputError):
            run(tmp_path, called)
        assert wall_s() == total
        (tmp_path / "run").mkdir(exist_ok=True)
    status.clear()
    run(tmp_path, called)
    assert wall_s() == 6.0 and finished_commands(tmp_path)[1] == 16.0
