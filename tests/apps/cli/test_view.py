"""`sceneprior view`: sentences for what cannot be shown, and Ctrl-C."""

import os
import signal
import socket
import subprocess
import sys
import urllib.request

import pytest
from cli_helpers import one_sentence

from sceneprior.core.scene import Scene, SceneObject
from sceneprior.render.scene_files import save


@pytest.fixture
def port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def test_the_extra_that_is_missing_is_named(command, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)  # what an import finds where there is none
    said = one_sentence(command("view", "run"))
    assert "needs viser, which is not installed; pip install 'sceneprior[view]'" in said


def test_what_cannot_be_shown_is_said(command, tmp_path, port):
    pytest.importorskip("viser", reason="the extra `view` is not installed")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", port))
        taken.listen()
        said = one_sentence(command("view", "run", "--port", port))
        assert f"Port {port} of 127.0.0.1 cannot be used (Address already in use)" in said
        assert f"--port {port + 1}" in said
    call = ["--port", port]
    assert "No prior at nowhere;" in one_sentence(command("view", "nowhere", *call))
    bed = SceneObject("double_bed", (0.0, 0.5, 0.0), (2.0, 1.0, 2.0))
    save(Scene("room", "front3d_bedroom", (bed,)), tmp_path / "rooms" / "room.json")
    said = one_sentence(command("view", "rooms", "--host", "no.such.host.invalid", *call))
    assert "of no.such.host.invalid cannot be used" in said


def test_ctrl_c_ends_it_with_one_sentence(start, tmp_path, port):
    pytest.importorskip("viser", reason="the extra `view` is not installed")
    bed = SceneObject("double_bed", (0.0, 0.5, 0.0), (2.0, 1.0, 2.0))
    for name in ("a", "b"):
        save(Scene(name, "front3d_bedroom", (bed,)), tmp_path / f"{name}.json")
    process = start(
        [sys.executable, "-m", "sceneprior", "view", str(tmp_path), "--port", str(port)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert process.stdout.readline() == (
        f"Open http://localhost:{port} in a browser. Ctrl-C ends it.\n"
    )
    with urllib.request.urlopen(f"http://127.0.0.1:{port}") as page:
        assert b"<html" in page.read().lower()
    os.kill(process.pid, signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert output.strip() == "Stopped: the page is closed." and process.returncode == 0
