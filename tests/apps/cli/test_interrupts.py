"""Ctrl-C ends a command with one sentence and status 130, wherever it arrives."""

import subprocess
import sys

import pytest

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
