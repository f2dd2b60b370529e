"""The entry point: one sentence for what does not work, and nothing half-written."""

import errno
import io
import os
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from cli_helpers import one_sentence, refuses
from tiny_runs import write_tiny_config

from sceneprior.apps import cli
from sceneprior.core import files
from sceneprior.core.errors import InputWarning
from sceneprior.core.shards import list_shards


def refuse(number: int):
    """Stands in for a call that the operating system refuses."""

    def refused(*_):
        raise OSError(number, os.strerror(number))

    return refused


def test_damaged_shards_are_a_sentence_and_leave_no_run(command, toy_shards, tmp_path):
    corrupt = shutil.copytree(toy_shards, tmp_path / "corrupt")
    victim = list_shards(corrupt, "train")[1]
    victim.write_bytes(victim.read_bytes()[:3000])
    config = write_tiny_config(tmp_path / "tiny.yaml", corrupt)
    said = one_sentence(command("fit", "--config", config, "--run", "run", "--accelerator", "cpu"))
    assert str(victim) in said and "the file is damaged. Delete it and run the same" in said
    assert not (tmp_path / "run").exists()


def test_options_that_lightning_refuses_are_a_sentence(command, toy_shards, tmp_path):
    call = ["fit", "--config", "paper/bedroom_small.yaml", "--run", "new", "--set"]
    said = one_sentence(command(*call, f"data.shards={toy_shards}", "--accelerator", "quantum"))
    assert "Lightning cannot train with accelerator quantum: " in said
    assert not (tmp_path / "new").exists()


def test_unforeseen_errors_are_one_line_and_status_1(command, monkeypatch):
    def broken(*_):
        raise KeyError("surprise")

    monkeypatch.setattr("sceneprior.apps.config.load_config", broken)
    status, _, errors = command("fit", "--config", "demo.yaml")
    assert status == 1 and errors.startswith("Error: KeyError: 'surprise'\n")
    assert "SCENEPRIOR_DEBUG=1" in errors and "Traceback" not in errors


@pytest.mark.parametrize("name", ["ENOSPC", "EROFS", "EACCES", "ENOENT", "EDQUOT", "EMFILE"])
def test_what_the_system_refuses_is_a_sentence(command, monkeypatch, name):
    monkeypatch.setattr("sceneprior.apps.config.load_config", refuse(getattr(errno, name)))
    refuses(command, f"cli/system_{name}", "fit", "--config", "demo.yaml")


@pytest.mark.parametrize("threads", ["0", "x", "-1"])
def test_a_variable_that_numba_would_trip_over_is_named(command, monkeypatch, threads):
    monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
    assert "NUMBA_NUM_THREADS" in one_sentence(command("fit", "--config", "demo.yaml"))


@pytest.mark.parametrize("encoding", ["latin-1", "ascii", "utf-8"])
def test_a_terminal_prints_what_it_cannot(monkeypatch, encoding):
    written = io.BytesIO()
    monkeypatch.setattr("sceneprior.apps.cli.commands.app", lambda: print("caf\xe9 \u2603 \udcff"))
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding))
    cli.main()
    sys.stdout.flush()
    assert written.getvalue().startswith(b"caf") and written.getvalue().endswith(b"\\udcff\n")


def test_numbers_in_damaged_files_are_no_warning(monkeypatch, capsys):
    def app():
        np.array([np.inf]) * 0
        warnings.warn("a file is odd.", InputWarning, stacklevel=1)

    monkeypatch.setattr("sceneprior.apps.cli.commands.app", app)
    cli.main()
    assert capsys.readouterr().err == "Warning: a file is odd.\n"


@pytest.mark.parametrize("out", ["loop", "loop/x"])
def test_a_link_to_itself_is_a_sentence(command, out):
    Path("loop").symlink_to("loop")
    one_sentence(command("synthesize", "--run", "demo-bedroom", "-n", 1, "--out", out))


@pytest.mark.parametrize(
    "words",
    [
        ("synthesize", "-n", 1, "--out"),
        ("pack", "--out"),
        ("eval-fid", "-n", 2, "--resamples", 0, "--out"),
        ("report", "--out"),
    ],
    ids=lambda words: words[0],
)
def test_what_a_command_could_not_write_is_named(command, toy_run, monkeypatch, words):
    name, *more = words
    monkeypatch.setattr(files.os, "fsync", refuse(errno.ENOSPC))
    run = [toy_run] if name == "pack" else ["--run", toy_run]
    refuses(command, "cli/full_disk", name, *run, *more, "target")
    assert not list(Path().iterdir())


def test_a_folder_that_is_not_empty_is_noticed_before_torch_is_imported(tmp_path):
    (tmp_path / "file").touch()
    words = ["sceneprior", "synthesize", "--run", "demo-bedroom", "--out", str(tmp_path)]
    code = (
        f"import sys; sys.argv = {words!r}\nfrom sceneprior.apps import cli\n"
        "try:\n    cli.main()\nfinally:\n    print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "False\n" and "is not empty; add --overwrite" in done.stderr


def test_a_page_needs_its_extra_and_a_host(command, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "viser", None)  # what an import finds where there is none
        refuses(command, "cli/view_without_viser", "view", "run")
    pytest.importorskip("viser", reason="the extra `view` is not installed")
    said = one_sentence(command("view", "run", "--host", "no.such.host.invalid"))
    assert "of no.such.host.invalid cannot be used" in said
