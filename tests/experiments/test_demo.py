"""Which steps of the demo are done again, with commands that only leave their results."""

import json
from pathlib import Path

import pytest

from sceneprior.errors import InputError
from sceneprior.experiments import demo
from sceneprior.experiments.demo import RESULTS, run_demo

STEPS = ["make-homes", "prep-front", "fit", "synthesize", "eval-fid", "report"]


@pytest.fixture
def ran(tmp_path, monkeypatch):
    """Verbs that were called, and their exit status by verb."""
    called: list[str] = []
    status: dict[str, int] = {}
    results = dict(zip(STEPS, RESULTS.values(), strict=True))

    def measure(arguments):
        called.append(arguments[0])
        if not status.get(arguments[0]):
            path = tmp_path / results[arguments[0]]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps({"protocol": {}}))
        return status.get(arguments[0], 0), 2.0, 0.5

    monkeypatch.setattr(demo, "_measure", measure)
    return called, status


def run(out: Path, called: list[str]) -> list[str]:
    called.clear()
    run_demo(out, "demo.yaml", 20, 4, "auto")
    return list(called)


def test_finished_steps_are_not_repeated(ran, tmp_path):
    assert run(tmp_path, ran[0]) == STEPS
    assert run(tmp_path, ran[0]) == []


def test_what_follows_a_step_that_is_done_again_is_done_again(ran, tmp_path):
    called, status = ran
    run(tmp_path, called)
    (tmp_path / RESULTS["fit"]).unlink()
    status["synthesize"] = 2
    with pytest.raises(InputError, match="The demo stopped at 'scenes'"):
        run(tmp_path, called)
    status.clear()
    # Scores of the former prior are there, and are not taken for the new one's.
    assert run(tmp_path, called) == ["synthesize", "eval-fid", "report"]
    assert run(tmp_path, called) == []
