"""The folder that is written: one run at a time, nothing half-written, a sentence if it fails."""

import contextlib
import errno
import fcntl
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sceneprior.errors import InputError
from sceneprior.files import remove_parts, write_whole

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextlib.contextmanager
def claimed(out: Path) -> Iterator[None]:
    """Be the only run that writes to `out`; begin without the leftovers of a killed one.

    Folders made for this go again if nothing came to lie in them.

    Raises:
        InputError: another run writes there, or it cannot be written.
    """
    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        # The folder itself is locked: no lock file stays, and the kernel frees it after a kill.
        descriptor = os.open(out, os.O_RDONLY)
    try:
        _lock(descriptor, out)
        with writing(out):
            remove_parts(out)
        yield
    finally:
        os.close(descriptor)
        with contextlib.suppress(OSError):
            for folder in made:
                folder.rmdir()


def _lock(descriptor: int, out: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise InputError(
            f"Another run is writing to {out}; wait for it, or choose another folder."
        ) from None
    except OSError:
        pass  # some network folders have no locks


@contextlib.contextmanager
def writing(out: Path, what: str = "") -> Iterator[None]:
    """Turn an OSError of writing into a sentence that says what is kept and how to go on.

    Args:
        out: The folder of the job.
        what: What is lost, such as the rooms of a shard.

    Raises:
        InputError: the sentence.
    """
    try:
        yield
    except OSError as error:
        where = error.filename or out
        about = f" ({what})" if what else ""
        advice = "make room on the disk and " if error.errno in _FULL else ""
        raise InputError(
            f"{where}{about} cannot be written ({error.strerror or error}). "
            f"Finished shards are kept: {advice}run the same command again to go on."
        ) from None


def write_json(path: Path, data: Any) -> None:
    """Write JSON, whole or not at all.

    Raises:
        OSError: it cannot be written.
    """
    write_changed(path, (json.dumps(data, indent=1) + "\n").encode())


def write_changed(path: Path, data: bytes) -> None:
    """Write a file unless it says this already: a finished folder may be read-only.

    Raises:
        OSError: it cannot be written.
    """
    with contextlib.suppress(OSError):
        if path.read_bytes() == data:
            return
    write_whole(path, data)
