"""Files that are whole or absent: bytes in, one atomic rename out."""

import contextlib
import os
import secrets
from pathlib import Path

PART = ".part"
"""How the name of a file ends that is still being written."""


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that no reader, and no crash, ever meets half of it.

    The bytes go to `<name>.<random>.part` beside it, reach the disk, and are renamed. A process
    that is killed leaves at most such a `.part` file; `remove_parts` clears them away.

    Raises:
        OSError: it cannot be written; `filename` is set, and what was there before stays.
    """
    path = Path(path)
    # Random, not the process id: machines of a cluster share folders, and not their process ids.
    temporary = path.with_name(f"{path.name}.{secrets.token_hex(4)}{PART}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as undo:
            undo.callback(_remove, temporary)
            with temporary.open("xb") as file:
                file.write(data)
                file.flush()
                # Without this a power cut may keep the new name and lose the bytes.
                os.fsync(file.fileno())
            temporary.replace(path)
            undo.pop_all()
    except OSError as error:
        error.filename = str(path)
        raise
    _sync_folder(path.parent)


def remove_parts(folder: Path) -> None:
    """Delete what killed writers left anywhere under a folder; nobody may be writing there.

    Raises:
        OSError: the folder cannot be changed.
    """
    for path in sorted(Path(folder).rglob(f"*{PART}")):
        path.unlink(missing_ok=True)


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    """Let the rename itself reach the disk, so that files appear in the order they were written."""
    with contextlib.suppress(OSError):  # some file systems sync no folders
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
