"""The command line: commands that work on a toy run, and one sentence for what does not."""

import base64
import errno
import io
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import trimesh
from cli_helpers import everything_in, one_sentence
from tiny_runs import write_tiny_config

from sceneprior.core import files
from sceneprior.core.shards import list_shards


def test_bad_shards_are_sentences_and_leave_no_run(command, toy_shards, tmp_path):
    def fit(shards: Path, *more) -> str:
        config = write_tiny_config(tmp_path / "tiny.yaml", shards)
        before = everything_in(tmp_path)
        said = one_sentence(
            command("fit", "--config", config, "--run", "run", "--accelerator", "cpu", *more)
        )
        assert everything_in(tmp_path) == before  # nothing half-written
        return said

    assert "No folder of shards at " in fit(tmp_path / "nowhere")

    empty = tmp_path / "empty"
    (empty / "train").mkdir(parents=True)
    assert "empty has no index.json; it is not a finished folder of shards" in fit(empty)

    corrupt = shutil.copytree(toy_shards, tmp_path / "corrupt")
    victim = list_shards(corrupt, "train")[1]
    victim.write_bytes(victim.read_bytes()[:3000])
    said = fit(corrupt)
    assert str(victim) in said and "the file is damaged. Delete it and run the same" in said
    victim.write_bytes(b"")
    assert "the file is damaged" in fit(corrupt)

    assert "model.max_objects is 2; raise it." in fit(toy_shards, "--set", "model.max_objects=2")


def test_synthesize_writes_rooms_and_the_same_again(command, toy_run, tmp_path):
    call = ["synthesize", "--run", toy_run, "-n", "3", "--seed", "5"]
    status, out, _ = command(*call, "--out", "made")
    assert (status, out) == (0, "Wrote 3 rooms to made (from: paper)\n")
    names = {f"seed5_000{k}.{kind}" for k in range(3) for kind in ("json", "glb", "png")}
    names |= {"overview.png", "latents.npz"}
    assert {path.name for path in (tmp_path / "made").iterdir()} == names
    scene = json.loads((tmp_path / "made" / "seed5_0000.json").read_text())
    assert scene["label_set"] == "front3d_bedroom" and scene["units"] == "metres"
    command(*call, "--out", "again")
    assert everything_in(tmp_path / "made") == everything_in(tmp_path / "again")
    before = everything_in(tmp_path)
    said = one_sentence(command(*call, "--out", "made"))
    assert "made is not empty; add --overwrite or name another folder." in said
    said = one_sentence(command(*call, "--out", "other", "--distribution", "guess"))
    assert "No sampling distribution 'guess'; choose from " in said
    assert everything_in(tmp_path) == before
    assert command(*call, "--out", "made", "--overwrite", "--html")[0] == 0
    page = (tmp_path / "made" / "rooms.html").read_text()
    assert page.count("<model-viewer ") == 3 and "seed 5 · from: paper" in page
    assert command(*call, "--out", "made", "--overwrite")[0] == 0
    assert everything_in(tmp_path) == before


def test_synthesize_writes_walls_if_asked(command, toy_run, tmp_path):
    call = ["synthesize", "--run", toy_run, "-n", 1, "--html", "--out"]
    for shell, nodes in (("walls", {"floor", "wall_0", "ceiling"}), ("none", set())):
        assert command(*call, shell, "--shell", shell)[0] == 0
        found = set(trimesh.load_scene(tmp_path / shell / "seed0_0000.glb").graph.nodes_geometry)
        assert found & {"floor", "wall_0", "ceiling"} == nodes
        page = (tmp_path / shell / "rooms.html").read_text()
        (model,) = re.findall('src="data:model/gltf-binary;base64,([^"]+)"', page)
        model = trimesh.load_scene(io.BytesIO(base64.b64decode(model)), file_type="glb")
        shown = set(model.graph.nodes_geometry) & {"floor", "wall_0", "ceiling"}
        assert shown == {"floor"} | nodes  # a page shows the floor in any case
    pictures = [(tmp_path / shell / "overview.png").read_bytes() for shell in ("walls", "none")]
    assert pictures[0] != pictures[1]
    said = one_sentence(command(*call, "other", "--shell", "roof"))
    assert "--shell roof is not known; choose from walls, floor, none." in said


def test_unforeseen_errors_are_one_line_and_status_1(command, monkeypatch):
    def broken(*_):
        raise KeyError("surprise")

    monkeypatch.setattr("sceneprior.apps.config.load_config", broken)
    status, _, errors = command("fit", "--config", "demo.yaml")
    assert status == 1 and errors.startswith("Error: KeyError: 'surprise'\n")
    assert "SCENEPRIOR_DEBUG=1" in errors and "Traceback" not in errors


def test_options_that_lightning_refuses_are_a_sentence_and_leave_nothing(
    command, toy_shards, tmp_path
):
    config = "paper/bedroom_small.yaml"  # opens its data silently
    call = ["fit", "--config", config, "--run", "new", "--set", f"data.shards={toy_shards}"]
    said = one_sentence(command(*call, "--accelerator", "quantum"))
    assert "Lightning cannot train with --devices auto, --accelerator quantum" in said
    assert not (tmp_path / "new").exists()


def refuse(number: int):
    def refused(*_):
        raise OSError(number, os.strerror(number))

    return refused


@pytest.mark.parametrize(
    ("number", "advice"),
    [
        (
            errno.ENOSPC,
            "(No space left on device); free space on its disk, or name another folder.",
        ),
        (errno.EROFS, "(Read-only file system); name a folder that can be written."),
        (errno.EACCES, "(Permission denied); change its permissions, or name another"),
        (errno.ENOENT, "(No such file or directory); check the path, or name another folder."),
        (errno.EDQUOT, "(Disk quota exceeded); free space in your quota"),
        (errno.EMFILE, "(Too many open files); allow more open files with `ulimit -n 4096`."),
    ],
)
def test_what_the_system_refuses_is_a_sentence(command, monkeypatch, number, advice):
    monkeypatch.setattr("sceneprior.apps.config.load_config", refuse(number))
    said = one_sentence(command("fit", "--config", "demo.yaml"))
    assert f"A file cannot be read or written {advice}" in said


@pytest.mark.parametrize(
    "words",
    [
        ("make-homes", "--rooms", 2),
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
    monkeypatch.setattr("data_prep.homes.make._write_split", refuse(errno.ENOSPC))
    run = {"make-homes": [], "pack": [toy_run]}.get(name, ["--run", toy_run])
    said = one_sentence(command(name, *run, *more, "target"))
    assert "target cannot be read or written (No space left on device); free space" in said
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


@pytest.mark.parametrize("words", [("synthesize", "-n", 1, "--out"), ("make-homes",)])
def test_a_folder_that_cannot_be_made_is_a_sentence(command, toy_run, words):
    name, *more = words
    run = [] if name == "make-homes" else ["--run", toy_run]
    said = one_sentence(command(name, *run, *more, "/proc/none"))
    assert "/proc/none" in said and "cannot be read or written (No such file or directory)" in said


def test_a_folder_is_no_file_for_results(command, toy_run, tmp_path):
    for words in (("eval-fid", "-n", 2), ("report",)):
        name, *rest = words
        said = one_sentence(command(name, "--run", toy_run, *rest, "--out", tmp_path))
        assert f"{tmp_path} is a folder; name a file with --out." in said


def test_commands_on_a_disk_that_is_full(command, toy_run, toy_shards, tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=100k", "tmpfs", str(disk)], capture_output=True
    )
    if mounted.returncode:
        pytest.skip("only root mounts a small disk")
    try:
        config = write_tiny_config(tmp_path / "tiny.yaml", toy_shards)
        cpu = ("--accelerator", "cpu")
        assert "homes cannot be" in on_full(command, "make-homes", disk / "homes", "--rooms", 2)
        said = on_full(command, "fit", "--config", config, "--run", disk / "run", *cpu)
        assert f"{disk / 'run'}" in said
        shutil.rmtree(disk / "run")
        (disk / "fill").write_bytes(bytes(96_000))
        said = on_full(command, "synthesize", "--run", toy_run, "--out", disk / "rooms")
        assert f"{disk / 'rooms'} cannot be" in said
        said = on_full(command, "fit", "--config", config, "--run", disk / "full", *cpu)
        assert f"{disk / 'full'}" in said
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def on_full(command, *words) -> str:
    status, _, errors = command(*words)
    last = errors.strip().splitlines()[-1]  # progress bars may stand before it
    assert status == 2 and "Traceback" not in errors, errors
    assert last.endswith(
        "(No space left on device); free space on its disk, or name another folder."
    )
    return last
