"""Help texts and refusals of all commands, whole, in `tests/golden/`."""

import os
import re
import socket
import sys
from pathlib import Path

import pytest
import typer
from cli_helpers import everything_in, one_sentence, refuses
from typer.testing import CliRunner

from sceneprior.apps.cli.commands import app
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.render.scene_files import save

HELP = Path(__file__).parents[2] / "golden" / "help"
COMMANDS = sorted(typer.main.get_command(app).commands)


@pytest.mark.parametrize("name", ["sceneprior", *COMMANDS])
def test_help_is_as_it_was(name, monkeypatch):
    """`TAKE_HELP=1 pytest ...` writes the texts that changed."""
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.delenv("TERMINAL_WIDTH", raising=False)
    words = [] if name == "sceneprior" else [name]
    done = CliRunner().invoke(app, [*words, "--help"], prog_name="sceneprior")
    text = re.sub(r"\x1b\[[0-9;]*m", "", done.output).strip()
    text = "\n".join(line.rstrip() for line in text.splitlines()) + "\n"
    path = HELP / f"{name}.txt"
    if os.environ.get("TAKE_HELP"):
        path.write_text(text)
    assert text == path.read_text()


def test_no_help_is_of_a_command_that_went():
    assert {path.stem for path in HELP.glob("*.txt")} == {"sceneprior", *COMMANDS}


RUN = ("--run", "demo-bedroom")
OUT = ("--out", "new")
REFUSED = {
    "evaluate_nothing": ["evaluate"],
    "evaluate_run_and_scenes": ["evaluate", *RUN, "--scenes", "rooms"],
    "evaluate_scenes_of_a_distribution": [
        "evaluate", "--scenes", "rooms", "--distribution", "paper"
    ],
    "evaluate_scenes_as_requested": ["evaluate", "--scenes", "rooms", "--floor", "4x3"],
    "eval_fid_nothing": ["eval-fid"],
    "eval_fid_scenes_without_shards": ["eval-fid", "--scenes", "rooms"],
    "eval_fid_of_a_file": ["eval-fid", *RUN],
    "report_nothing": ["report", *RUN, "--scenes", "rooms"],
    "report_scenes_with_a_seed": [
        "report", "--scenes", "rooms", "--shards", "shards", "--seed", 1
    ],
    "report_into_a_folder": [
        "report", "--scenes", "rooms", "--shards", "shards", "--out", "rooms"
    ],
    "reconstruct_nothing": ["reconstruct", *RUN, *OUT],
    "reconstruct_two_ways": [
        "reconstruct", *RUN, *OUT, "--shards", "s", "--room", "a", "--split", "test"
    ],
    "reconstruct_mask_without_intrinsics": ["reconstruct", *RUN, *OUT, "--mask", "a.png"],
    "reconstruct_shards_with_classes": [
        "reconstruct", *RUN, *OUT, "--shards", "s", "--room", "a", "--classes", "c.csv"
    ],
    "reconstruct_pose_and_gravity": [
        "reconstruct", *RUN, *OUT, "--mask", "a.png", "--pose", "p.json", "--gravity", "0,1,0"
    ],
    "reconstruct_limit_of_a_room": [
        "reconstruct", *RUN, *OUT, "--shards", "s", "--room", "a", "--limit", 1
    ],
    "eval_svr_nothing": ["eval-svr", "--shards", "s"],
    "eval_svr_scenes_with_views": ["eval-svr", "--shards", "s", "--scenes", "rooms", "--views", 2],
    "pack_over_a_folder": ["pack", "run", "--out", "rooms"],
    "pack_about_a_device": ["pack", "run", *OUT, "--about", "/dev/zero"],
    "priors_of_a_run": ["priors", "run"],
    "export_box_lists_without_labels": ["export", "rooms", "--to", "scenes", *OUT],
    "export_with_labels": ["export", "rooms", "--to", "obj", *OUT, "--label-set", "x"],
    "export_over_a_folder": ["export", "rooms", "--to", "obj", "--out", "rooms"],
    "synthesize_over_a_folder": ["synthesize", *RUN, "--out", "rooms"],
    "synthesize_unknown_shell": ["synthesize", *RUN, *OUT, "--shell", "roof"],
    "synthesize_unknown_distribution": ["synthesize", *RUN, *OUT, "--distribution", "guess"],
    "synthesize_twice_the_floor": [
        "synthesize", *RUN, *OUT, "--floor", "4x3", "--request", "request.json"
    ],
    "synthesize_no_floor": ["synthesize", *RUN, *OUT, "--floor", "wide"],
    "interpolate_no_latent": ["interpolate", *RUN, *OUT, "--from", "attic", "--to", "seed:1"],
    "complete_without_a_room": ["complete", *RUN, *OUT, "--given", "gone.json"],
    "complete_classes_and_wishes": [
        "complete", *RUN, *OUT, "--given", "rooms/room.json", "--classes", "desk", "--want", "a bed"
    ],
    "retrieve_no_scenes": ["retrieve", *OUT, "--scenes", "run"],
    "view_nothing": ["view", "nowhere"],
    "view_scenes_as_requested": ["view", "rooms", "--floor", "4x3"],
    "view_unknown_shell": ["view", "rooms", "--shell", "roof"],
}  # fmt: skip


@pytest.fixture
def files(command, tmp_path):
    """A room at `rooms/room.json`, a folder `run` with a config, and a request."""
    bed = SceneObject("double_bed", (0.0, 0.5, 0.0), (2.0, 1.0, 2.0))
    save(Scene("room", "front3d_bedroom", (bed,)), tmp_path / "rooms" / "room.json")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text("method: lifted\n")
    request = '{"format": "sceneprior-request", "version": 1, "floor": "4x3"}'
    (tmp_path / "request.json").write_text(request)
    return command


@pytest.mark.parametrize("key", REFUSED)
def test_what_is_refused_is_one_sentence_and_writes_nothing(key, files, tmp_path):
    words = REFUSED[key]
    if key.startswith("view"):
        pytest.importorskip("viser", reason="the extra `view` is not installed")
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            words = [*words, "--port", free.getsockname()[1]]
    before = everything_in(tmp_path)
    refuses(files, f"cli/{key}", *words, tmp=tmp_path)
    assert everything_in(tmp_path) == before


def test_a_page_needs_its_extra_and_a_free_port(command, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "viser", None)  # what an import finds where there is none
        refuses(command, "cli/view_without_viser", "view", "run")
    pytest.importorskip("viser", reason="the extra `view` is not installed")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        refuses(
            command, "cli/view_taken_port", "view", "run", "--port", port, port=port,
            next=port + 1,
        )  # fmt: skip
    said = one_sentence(command("view", "run", "--host", "no.such.host.invalid"))
    assert "of no.such.host.invalid cannot be used" in said
