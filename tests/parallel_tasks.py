"""Tasks that workers import: they square a number, fail, or kill their process."""

import os
import signal
import time
from pathlib import Path

from sceneprior.core.errors import InputError


def square(number: int) -> int:
    return number * number


def fail_at_two(number: int, folder: Path) -> None:
    (folder / f"{number}").touch()
    if number == 2:
        raise InputError("Two is not a number of chairs.")
    if number == 4:
        raise KeyError("surprise")


def die_at_two(number: int, folder: Path, times: int) -> int:
    """Two kills its process the first `times` times."""
    before = len(list(folder.glob("death*")))
    if number == 2 and before < times:
        (folder / f"death{before}").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.05)
    (folder / f"{number}").touch()
    return number
