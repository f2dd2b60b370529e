"""Help texts and refusals of all commands, whole, in `tests/golden/`; `TAKE=1 pytest ...` writes
those that changed."""

import re
import shlex
import socket

import pytest
import typer
from cli_helpers import everything_in, one_sentence
from golden_values import FOLDER, TAKE, assert_text
from tiny_runs import write_tiny_config
from typer.testing import CliRunner

from sceneprior.apps.cli.commands import app
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.render.scene_files import save

HELP, REFUSED = FOLDER / "help", FOLDER / "refused_commands.txt"
COMMANDS = sorted(typer.main.get_command(app).commands)
CALLS = re.findall(r"(?m)^\$ (.*)$", REFUSED.read_text())


@pytest.mark.parametrize("name", ["sceneprior", *COMMANDS])
def test_help_is_as_it_was(name, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.delenv("TERMINAL_WIDTH", raising=False)
    words = [] if name == "sceneprior" else [name]
    done = CliRunner().invoke(app, [*words, "--help"], prog_name="sceneprior")
    text = re.sub(r"\x1b\[[0-9;]*m", "", done.output).strip()
    text = "\n".join(line.rstrip() for line in text.splitlines()) + "\n"
    assert_text(f"help/{name}.txt", text)


def test_no_help_is_of_a_command_that_went():
    assert {path.stem for path in HELP.glob("*.txt")} == {"sceneprior", *COMMANDS}


@pytest.fixture
def places(toy_run, toy_shards, tmp_path):
    """Files that the commands name, and the values of `{names}` in the golden file."""
    bed = SceneObject("double_bed", (0.0, 0.5, 0.0), (2.0, 1.0, 2.0))
    save(Scene("room", "front3d_bedroom", (bed,)), tmp_path / "rooms" / "room.json")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text("method: lifted\n")
    (tmp_path / "empty" / "train").mkdir(parents=True)
    request = '{"format": "sceneprior-request", "version": 1, "floor": "4x3"}'
    (tmp_path / "request.json").write_text(request)
    config = write_tiny_config(tmp_path / "tiny.yaml", toy_shards)
    with socket.socket() as taken, socket.socket() as free:
        for each in (taken, free):
            each.bind(("127.0.0.1", 0))
        taken.listen()
        ports = {"taken": taken.getsockname()[1], "free": free.getsockname()[1]}
        free.close()
        yield {"config": config, "run": toy_run, "shards": toy_shards, **ports}


@pytest.mark.parametrize("call", CALLS)
def test_what_is_refused_is_one_sentence_and_writes_nothing(call, command, places, tmp_path):
    if call.startswith("view"):
        pytest.importorskip("viser", reason="the extra `view` is not installed")
    before = everything_in(tmp_path)
    said = one_sentence(command(*shlex.split(call.format(**places)))).removeprefix("Error: ")
    assert everything_in(tmp_path) == before
    for name, value in {**places, "next": places["taken"] + 1}.items():
        said = said.replace(str(value), f"{{{name}}}")
    known = REFUSED.read_text()
    start = f"$ {call}\n"
    if TAKE:
        head, _, tail = known.partition(start)
        known = f"{head}{start}{said}\n{tail[tail.find('$ ') :] if '$ ' in tail else ''}"
        REFUSED.write_text(known)
    assert f"{start}{said}\n" in known
