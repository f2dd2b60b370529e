"""The entry point: one sentence for what does not work, and nothing half-written."""

import errno
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from cli_helpers import everything_in, one_sentence, refuses
from tiny_runs import write_tiny_config

from sceneprior.core import files
from sceneprior.core.shards import list_shards


def refuse(number: int):
    """Stands in for a call that the operating system refuses."""

    def refused(*_):
        raise OSError(number, os.strerror(number))

    return refused


def test_bad_shards_are_sentences_and_leave_no_run(command, toy_shards, tmp_path):
    def fit(shards: Path, *more) -> tuple:
        config = write_tiny_config(tmp_path / "tiny.yaml", shards)
        return "fit", "--config", config, "--run", "run", "--accelerator", "cpu", *more

    def refused(key: str, shards: Path, *more) -> None:
        call = fit(shards, *more)
        before = everything_in(tmp_path)
        refuses(command, f"cli/fit_{key}", *call, tmp=tmp_path, shards=toy_shards)
        assert everything_in(tmp_path) == before  # nothing half-written

    refused("no_shards", tmp_path / "nowhere")
    refused("two_objects", toy_shards, "--set", "model.max_objects=2")
    empty = tmp_path / "empty"
    (empty / "train").mkdir(parents=True)
    refused("unfinished_shards", empty)
    corrupt = shutil.copytree(toy_shards, tmp_path / "corrupt")
    victim = list_shards(corrupt, "train")[1]
    for content in (victim.read_bytes()[:3000], b""):
        victim.write_bytes(content)
        said = one_sentence(command(*fit(corrupt)))
        assert str(victim) in said and "the file is damaged. Delete it and run the same" in said


def test_options_that_lightning_refuses_are_a_sentence(command, toy_shards, tmp_path):
    config = "paper/bedroom_small.yaml"  # opens its data silently
    call = ["fit", "--config", config, "--run", "new", "--set", f"data.shards={toy_shards}"]
    said = one_sentence(command(*call, "--accelerator", "quantum"))
    assert "Lightning cannot train with --devices auto, --accelerator quantum" in said
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


@pytest.mark.parametrize("words", [("synthesize", "-n", 1, "--out"), ("make-homes",)])
def test_a_folder_that_cannot_be_made_is_a_sentence(command, toy_run, words):
    name, *more = words
    run = [] if name == "make-homes" else ["--run", toy_run]
    said = one_sentence(command(name, *run, *more, "/proc/none"))
    assert "/proc/none" in said and "cannot be read or written (No such file or directory)" in said


def test_a_folder_that_is_not_empty_is_noticed_before_torch_is_imported(tmp_path):
    (tmp_path / "file").touch()
    words = ["sceneprior", "synthesize", "--run", "demo-bedroom", "--out", str(tmp_path)]
    code = (
        f"import sys; sys.argv = {words!r}\nfrom sceneprior.apps import cli\n"
        "try:\n    cli.main()\nfinally:\n    print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "False\n" and "is not empty; add --overwrite" in done.stderr


@pytest.mark.slow
def test_commands_on_a_disk_that_is_full(command, toy_run, toy_shards, tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=100k", "tmpfs", str(disk)], capture_output=True
    )
    if mounted.returncode:
        pytest.skip("only root mounts a small disk")

    def on_full(*words) -> str:
        status, _, errors = command(*words)
        last = errors.strip().splitlines()[-1]  # progress bars may stand before it
        assert status == 2 and "Traceback" not in errors, errors
        assert last.endswith(
            "(No space left on device); free space on its disk, or name another folder."
        )
        return last

    try:
        config = write_tiny_config(tmp_path / "tiny.yaml", toy_shards)
        fit = ["fit", "--accelerator", "cpu", "--config", config, "--run"]
        assert "homes cannot be" in on_full("make-homes", disk / "homes", "--rooms", 2)
        assert f"{disk / 'run'}" in on_full(*fit, disk / "run")
        shutil.rmtree(disk / "run")
        (disk / "fill").write_bytes(bytes(96_000))
        said = on_full("synthesize", "--run", toy_run, "--out", disk / "rooms")
        assert f"{disk / 'rooms'} cannot be" in said
        assert f"{disk / 'full'}" in on_full(*fit, disk / "full")
    finally:
        subprocess.run(["umount", str(disk)], check=True)
