"""Commands of experiments: what is recorded of one that ends, fails or is stopped."""

import json
import signal
import subprocess
import sys
from functools import partial

import pytest
import torch

from sceneprior.apps.cli.commands import app
from sceneprior.apps.experiments import commands
from sceneprior.apps.experiments.commands import Command, is_done, run_command, running_commands
from sceneprior.core.errors import InputError
from sceneprior.core.files import only_writer

MAIN = partial(app, standalone_mode=False)


@pytest.fixture
def version(tmp_path) -> Command:
    """A command that ends at once; its log is what it leaves."""
    return Command("say", ["--version"], tmp_path / "say.log", depends_on=["a"])


def test_a_command_is_printed_logged_recorded_and_done(version, tmp_path, capsys):
    run_command(MAIN, version, tmp_path, version.result)
    assert capsys.readouterr().err == "$ sceneprior --version\n"
    assert version.result.read_text().startswith("sceneprior 0.")
    noted = json.loads((tmp_path / "steps.json").read_text())["say"]
    assert noted["arguments"] == ["--version"] and noted["finished"]
    assert 0 <= noted["cpu_s"] < 60 and noted["wall_s"] > 0
    assert is_done(version, tmp_path)
    assert not is_done(Command("say", ["--version"], version.result, ["b"]), tmp_path)
    version.result.unlink()
    assert not is_done(version, tmp_path)


def test_a_failed_command_is_its_own_sentence_and_drops_what_came_after(version, tmp_path):
    (tmp_path / "steps.json").write_text('{"first": {}, "fail": {}, "say": {"finished": true}}')
    command = Command("fail", ["inspect", "nowhere"], tmp_path / "no", depends_on=[])
    with pytest.raises(InputError, match="nowhere"):
        run_command(MAIN, command, tmp_path, tmp_path / "fail.log")
    assert (tmp_path / "fail.log").read_text().startswith("Error: ")
    noted = json.loads((tmp_path / "steps.json").read_text())
    assert list(noted) == ["first", "fail"] and not noted["fail"]["finished"]


def test_a_bug_is_a_sentence_with_its_traceback_in_the_log(tmp_path, monkeypatch):
    def broken(*given):
        torch.set_num_threads(2)
        torch.set_float32_matmul_precision("medium")
        raise KeyError("lamp")

    before = torch.get_float32_matmul_precision()  # other tests may have trained
    monkeypatch.setattr("sceneprior.apps.config.load_config", broken)
    command = Command("fit", ["fit", "--config", "demo.yaml", "--run", "r"], tmp_path / "no", [])
    with pytest.raises(InputError, match=r"^KeyError: 'lamp'$"):
        run_command(MAIN, command, tmp_path, tmp_path / "fit.log")
    assert "Traceback" in (tmp_path / "fit.log").read_text() and torch.get_num_threads() == 1
    assert torch.get_float32_matmul_precision() == before != "medium"


def test_lightning_keeps_no_closed_log():
    code = """if True:
        import importlib, logging, os, pathlib
        from sceneprior.apps.experiments.commands import call

        def main(arguments):
            importlib.import_module("sceneprior.training.fit")

        call(main, [], pathlib.Path(os.devnull))
        loggers = [logging.getLogger(name) for name in list(logging.root.manager.loggerDict)]
        streams = [getattr(each, "stream", None) for log in loggers for each in log.handlers]
        assert any(streams) and not any(each.closed for each in streams if each)
    """
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_signals_stop_a_command_and_its_costs_are_recorded(tmp_path, monkeypatch, name):
    number = signal.Signals[name]
    monkeypatch.setattr(commands, "call", lambda *given: signal.raise_signal(number))
    # A program that was started with nohup or in the background ignores some of these signals.
    handler = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    before = signal.signal(number, handler)
    try:
        with pytest.raises(KeyboardInterrupt), running_commands(tmp_path):
            with pytest.raises(InputError, match="Another run is writing"), only_writer(tmp_path):
                pass
            run_command(MAIN, Command("wait", [], tmp_path / "no", []), tmp_path)
        assert signal.getsignal(number) is handler
    finally:
        signal.signal(number, before)
    noted = json.loads((tmp_path / "steps.json").read_text())["wait"]
    assert not noted["finished"] and 0 < noted["wall_s"] < 30
