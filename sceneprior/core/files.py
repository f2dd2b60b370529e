"""Atomic writes, folder locks, JSON, and checks of file names."""

import contextlib
import fcntl
import json
import os
import secrets
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from sceneprior.core.errors import InputError

PART = ".part"
"""Suffix of a file that is still being written."""
PARTS = f"*.{'[0-9a-f]' * 8}{PART}"
"""Glob pattern of the temporary files of `write_whole`."""
_LONGEST_NAME = 120
_TRIAL_BYTES = 2**16


def write_whole(path: Path, content: bytes | str | Callable[[Path], object]) -> None:
    """Write a file atomically: no reader sees a partial file, and no crash leaves one.

    The content is written to `<name>.<random>.part` in the same folder, synced to disk, and
    renamed. A killed process leaves at most such a `.part` file, which `remove_parts` deletes.
    Missing folders are created. `content` may be a function that writes to the path it gets.

    Raises:
        OSError: the file cannot be written; `filename` is set, and an existing file is unchanged.
    """
    path = Path(path)
    # Random, because process ids are not unique across machines that share the folder.
    temporary = path.with_name(f"{path.name}.{secrets.token_hex(4)}{PART}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if callable(content):
            content(temporary)
        else:
            temporary.write_bytes(content.encode() if isinstance(content, str) else content)
        # Without the sync, a power failure may keep the new name but lose the content.
        _sync(temporary)
        temporary.replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename = str(path)
        raise
    # The rename is synced, too, so that files appear in the order in which they were written.
    with contextlib.suppress(OSError):  # some file systems cannot sync folders
        _sync(path.parent)


def write_changed(path: Path, content: bytes | str) -> None:
    """Write a file unless it already has this content; its folder may then be read-only."""
    with contextlib.suppress(OSError):
        if path.read_bytes() == (content.encode() if isinstance(content, str) else content):
            return
    write_whole(path, content)


def json_text(data: Any) -> str:
    """Format plain data as JSON; NaN and infinity raise a `ValueError`."""
    return json.dumps(data, indent=1, allow_nan=False) + "\n"


def write_json(path: Path, data: Any) -> None:
    """Write plain data as JSON atomically; see `json_text` and `write_whole`."""
    write_whole(path, json_text(data))


def remove_parts(folder: Path) -> None:
    """Delete temporary files that killed writers left under a folder.

    No other process may be writing there.
    """
    for path in sorted(Path(folder).rglob(f"*{PART}")):
        path.unlink(missing_ok=True)


def check_writable(path: Path) -> None:
    """Check that a file or folder is writable, before work starts whose result goes there.

    Raises:
        OSError: it cannot be written; `filename` is `path`.
    """
    path = Path(path)
    folder = path if path.is_dir() else path.parent
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    trial = folder / f"{path.name}.{secrets.token_hex(4)}{PART}"
    try:
        write_whole(trial, bytes(_TRIAL_BYTES))
        trial.unlink()
    except OSError as error:
        error.filename = str(path)
        raise
    finally:
        _remove_empty(made)


def check_free(folder: Path, overwrite: bool) -> None:
    """Check that a folder can be written, and is empty unless `overwrite` is true."""
    folder = Path(folder)
    if folder.is_file():
        raise InputError(f"{folder} is a file; name a folder.")
    if not overwrite and folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"{folder} is not empty; add --overwrite or name another folder.")
    check_writable(folder)


@contextlib.contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Lock a folder for writing by this process, and create it if it is missing.

    Folders created here are removed again if they stay empty.
    """
    folder = Path(folder)
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    # Locking the folder itself leaves no lock file, and the kernel unlocks it after a kill.
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
        try:
            _remove_empty(made)
        finally:
            # Closing would not unlock while a forked process holds the descriptor, too.
            with contextlib.suppress(OSError):
                fcntl.flock(descriptor, fcntl.LOCK_UN)
            os.close(descriptor)


def _remove_empty(folders: list[Path]) -> None:
    with contextlib.suppress(OSError):
        for folder in folders:
            folder.rmdir()


def file_stamp(path: Path) -> tuple[int, int]:
    """Modification time (ns) and size (bytes) of a file, to detect changes."""
    try:
        status = path.stat()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}).") from None
    return status.st_mtime_ns, status.st_size


def read_json(path: Path) -> Any:
    """Read a JSON file."""
    try:
        return json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}).") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path.name} is not JSON ({error}); it may be truncated.") from None


def is_name(text: Any) -> bool:
    """Test whether a value is a short, printable string that can be one component of a path."""
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
