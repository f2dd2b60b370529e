"""Writes files whole or not at all, reads JSON, and says which texts can be names of files."""

import contextlib
import fcntl
import json
import os
import secrets
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from sceneprior.errors import InputError

PART = ".part"
"""How the name of a file ends that is still being written."""
_LONGEST_NAME = 120


def write_whole(path: Path, content: bytes | str | Callable[[Path], object]) -> None:
    """Write a file so that no reader, and no crash, ever meets half of it.

    The content goes to `<name>.<random>.part` beside it, reaches the disk, and is renamed. A
    process that is killed leaves at most such a `.part` file; `remove_parts` clears them away.

    Args:
        path: Missing folders are made.
        content: Bytes, a text (UTF-8), or a function that writes to the path it is given.

    Raises:
        OSError: it cannot be written; `filename` is set, and what was there before stays.
    """
    path = Path(path)
    # Random, not the process id: machines of a cluster share folders, and not their process ids.
    temporary = path.with_name(f"{path.name}.{secrets.token_hex(4)}{PART}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if callable(content):
            content(temporary)
        else:
            temporary.write_bytes(content.encode() if isinstance(content, str) else content)
        # Without this a power cut may keep the new name and lose the bytes.
        _sync(temporary)
        temporary.replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename = str(path)
        raise
    # The rename itself reaches the disk, too: files appear in the order they were written.
    with contextlib.suppress(OSError):  # some file systems sync no folders
        _sync(path.parent)


def write_changed(path: Path, content: bytes | str) -> None:
    """`write_whole`, unless the file says this already: a finished folder may be read-only."""
    with contextlib.suppress(OSError):
        if path.read_bytes() == (content.encode() if isinstance(content, str) else content):
            return
    write_whole(path, content)


def json_text(data: Any, indent: int = 1) -> str:
    """Plain data as every JSON file of ours is written; NaN and infinity are a `ValueError`."""
    return json.dumps(data, indent=indent, allow_nan=False) + "\n"


def write_json(path: Path, data: Any, indent: int = 1) -> None:
    """Write plain data as JSON, whole or not at all; see `json_text` and `write_whole`."""
    write_whole(path, json_text(data, indent))


def remove_parts(folder: Path) -> None:
    """Delete what killed writers left anywhere under a folder; no process may be writing there."""
    for path in sorted(Path(folder).rglob(f"*{PART}")):
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Make a folder, if it is not there, and be the only process that writes to it.

    Raises:
        InputError: another one writes there, by this function.
        OSError: it cannot be made.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    # The folder itself is locked: no lock file stays, and the kernel frees it after a kill.
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # some network folders have no locks
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError(
                    f"Another run is writing to {folder}; wait for it, or choose another folder."
                ) from None
        yield
    finally:
        os.close(descriptor)


def file_stamp(path: Path) -> tuple[int, int]:
    """Time of change and size: what tells a changed file from the one that was read."""
    try:
        status = path.stat()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}).") from None
    return status.st_mtime_ns, status.st_size


def read_json(path: Path) -> Any:
    """The JSON of a file; an `InputError` where it cannot be read, or is none."""
    try:
        return json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}).") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path.name} is not JSON ({error}); it may be truncated.") from None


def is_name(text: Any) -> bool:
    """Whether a text out of a file can be part of a path and of a report: short and printable."""
    return (
        isinstance(text, str)
        and 0 < len(text) <= _LONGEST_NAME
        and text.isprintable()
        and text not in (".", "..")
        and "/" not in text
    )


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
