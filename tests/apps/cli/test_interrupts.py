"""Ctrl-C ends a command with one sentence and status 130, wherever it arrives."""

import os
import signal
import socket
import subprocess
import sys
import urllib.request

import pytest

from sceneprior.core.scene import Scene, SceneObject
from sceneprior.render.scene_files import save

pytestmark = pytest.mark.slow
SENTENCE = "Stopped by Ctrl-C. No file is left half-written.\n"

# Stands for a command: it says "on", and does what Ctrl-C is to fall into. The others come after.
_COMMAND = """
import gc, signal, sys, time, weakref
import sceneprior.apps.cli, sceneprior.apps.cli.commands

def press():
    signal.raise_signal(signal.SIGINT)

def work():
    start = time.monotonic()
    {body}
    while time.monotonic() - start < 60:
        time.sleep(0.01)
    print("went on")

sceneprior.apps.cli.commands.app = work
sceneprior.apps.cli.main()
"""
BODIES = {
    "plain": "press()",
    "weak reference": "weakref.finalize; x = type('X', (), {})(); "
    "r = weakref.ref(x, lambda _: press()); del x",
    "bare except": "exec('try:\\n    press()\\nexcept:\\n    pass')",
    "another error": "exec('try:\\n    press()\\nexcept BaseException:\\n    raise ValueError')",
    "long clean-up": "exec('try:\\n    press()\\nfinally:\\n    time.sleep(1.5)\\n    print(1)')",
}


@pytest.fixture
def begin(start):
    """Start a Python process whose output is read."""

    def begin(*arguments: str, background: bool = False) -> subprocess.Popen:
        return start(
            [sys.executable, *arguments], background=background, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    return begin


@pytest.mark.parametrize("body", BODIES)
def test_ctrl_c_is_never_lost(begin, body):
    process = begin("-c", _COMMAND.format(body=BODIES[body]))
    said, errors = process.communicate(timeout=400)
    assert (process.returncode, errors) == (130, SENTENCE)
    assert said == ("1\n" if body == "long clean-up" else "")


def test_in_the_background_ctrl_c_stays_ignored(begin):
    body = "press(); print('on'); sys.exit(0)"
    process = begin("-c", _COMMAND.format(body=body), background=True)
    assert process.communicate(timeout=400) == ("on\n", "") and process.returncode == 0


def test_ctrl_c_ends_the_viewer(begin, tmp_path):
    pytest.importorskip("viser", reason="the extra `view` is not installed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    bed = SceneObject("double_bed", (0.0, 0.5, 0.0), (2.0, 1.0, 2.0))
    for name in ("a", "b"):
        save(Scene(name, "front3d_bedroom", (bed,)), tmp_path / f"{name}.json")
    process = begin("-m", "sceneprior", "view", str(tmp_path), "--port", str(port))
    address = f"Open http://localhost:{port} in a browser. Ctrl-C ends it.\n"
    assert process.stdout.readline() == address
    with urllib.request.urlopen(f"http://127.0.0.1:{port}") as page:
        assert b"<html" in page.read().lower()
    os.kill(process.pid, signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert output.strip() == "Stopped: the page is closed." and process.returncode == 0
