"""Commands of experiments, in real processes that do next to nothing."""

import json
import os
import resource
import signal
import sys
import threading
import time

import pytest

from sceneprior.apps.experiments.commands import (
    Command,
    call,
    failure_reason,
    is_done,
    run_command,
)
from sceneprior.core.errors import InputError


@pytest.fixture
def version(tmp_path) -> Command:
    """A command that ends at once; its log is what it leaves."""
    return Command("say", ["--version"], tmp_path / "say.log", depends_on=["a"])


def test_a_step_is_printed_logged_noted_and_done(version, tmp_path, capsys):
    run_command(version, tmp_path, version.result)
    assert capsys.readouterr().err == "$ sceneprior --version\n"
    assert version.result.read_text().startswith("sceneprior 0.")
    noted = json.loads((tmp_path / "steps.json").read_text())["say"]
    assert noted["arguments"] == ["--version"] and noted["finished"]
    assert noted["cpu_s"] > 0 and noted["wall_s"] > 0 and 0 <= noted["peak_memory_gib"] < 10
    assert is_done(version, tmp_path)
    other = Command("say", ["--version"], version.result, depends_on=["b"])
    assert not is_done(other, tmp_path)
    version.result.unlink()
    assert not is_done(version, tmp_path)


def test_a_failed_step_is_its_own_sentence_and_forgets_what_came_after(version, tmp_path):
    (tmp_path / "steps.json").write_text('{"first": {}, "fail": {}, "say": {"finished": true}}')
    step = Command("fail", ["inspect", "nowhere"], tmp_path / "no", depends_on=[])
    with pytest.raises(InputError, match="nowhere"):
        run_command(step, tmp_path, tmp_path / "fail.log")
    noted = json.loads((tmp_path / "steps.json").read_text())
    assert list(noted) == ["first", "fail"] and not noted["fail"]["finished"]


@pytest.mark.parametrize(
    ("name", "background"), [("SIGINT", False), ("SIGTERM", False), ("SIGTERM", True)]
)
def test_a_signal_stops_the_command_that_runs_and_what_it_took_is_noted(
    tmp_path, monkeypatch, name, background
):
    """A stand-in for the interpreter: it waits, and ends as SIGINT wants it."""
    script = tmp_path / "python"
    script.write_text(f"#!{sys.executable}\nprint('on', flush=True)\nimport time; time.sleep(60)\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))
    log = tmp_path / "log"
    step = Command("wait", [], tmp_path / "no", depends_on=[])

    def send() -> None:
        while not (log.exists() and log.read_text()):
            time.sleep(0.01)
        os.kill(os.getpid(), signal.Signals[name])

    # A shell starts what runs in the background so, and children inherit it.
    ignored = signal.SIG_IGN if background else signal.default_int_handler
    before = signal.signal(signal.SIGINT, ignored)
    sender = threading.Thread(target=send)
    try:
        sender.start()
        with pytest.raises(KeyboardInterrupt):
            run_command(step, tmp_path, log)
        assert signal.getsignal(signal.SIGINT) is ignored
    finally:
        sender.join()
        signal.signal(signal.SIGINT, before)
    noted = json.loads((tmp_path / "steps.json").read_text())["wait"]
    assert not noted["finished"] and 0 < noted["wall_s"] < 30
    assert "KeyboardInterrupt" in log.read_text()


def test_memory_is_that_of_the_largest_process(tmp_path, monkeypatch):
    """A stand-in for the interpreter: a shell whose child holds 100 MB."""
    shell = tmp_path / "python"
    shell.write_text(f'#!/bin/sh\n{sys.executable} -c "bytearray(100 << 20)"\ntrue\n')
    shell.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(shell))
    status, costs, _ = call([], None)
    # Linux counts what a process held before `exec`, which is what this one holds.
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    assert status == 0 and 0.1 < costs["peak_memory_gib"] < max(1, 1.1 * own)


def test_a_command_that_failed_is_told_by_its_own_sentence(tmp_path):
    log = tmp_path / "fit.log"
    log.write_text("10%\nError: ValueError: odd.\nThis should not happen. Run again.\n")
    assert failure_reason(log, 1) == "ValueError: odd."
    log.write_text("\n 73%\n")
    assert failure_reason(log, 1) == "73%"
    assert failure_reason(log, -9) == "killed by SIGKILL; run the same command again to continue"
    log.write_text("")
    assert failure_reason(log, 1) == f"it printed nothing to {log}"
    assert failure_reason(None, 3) == "exit status 3"
