"""Files: atomic writes, folder locks, lists of inputs, reading them, and their names."""

import contextlib
import csv
import errno
import fcntl
import hashlib
import io
import json
import os
import re
import secrets
import stat
import sys
import warnings
from collections.abc import Callable, Collection, Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sceneprior.core.errors import InputError
from sceneprior.core.errors import cause_of as cause_of

if TYPE_CHECKING:
    import h5py

PART = ".part"
"""Suffix of a file that is still being written."""
PARTS = f"*.{'[0-9a-f]' * 8}{PART}"
"""Glob pattern of the temporary files of `write_whole`."""
_LONGEST_NAME = 120
_MOST_BYTES = 1 << 31
_MOST_TEXT = 1 << 29
"""Maximum size of a text in bytes; COCO's largest table has 0.47 GB."""
_CLUTTER = frozenset(["Thumbs.db", "desktop.ini", "__MACOSX", "@eaDir"])
"""Names of what Windows, archives of macOS, and network disks add to folders."""
_NO_LOCKS = frozenset([errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP])
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
    for path in sorted(Path(folder).rglob(PARTS)):
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
    status = check_file(path, sys.maxsize)
    return status.st_mtime_ns, status.st_size


def list_files(folder: Path, pattern: str = "*", deep: bool = False) -> list[Path]:
    """List the files of a folder whose name matches, sorted; `deep` also looks in its folders.

    Dot files such as `._a.png` and `.DS_Store`, and other additions of operating systems, are
    never inputs: they are left out, with all that lies below such a folder. A folder that is
    missing has no files.

    Raises:
        InputError: a folder cannot be listed.
    """
    return sorted(path for path, is_folder in _entries(folder, pattern, deep) if not is_folder)


def list_folders(folder: Path, pattern: str = "*") -> list[Path]:
    """List the folders in a folder as `list_files` lists its files."""
    return sorted(path for path, is_folder in _entries(folder, pattern) if is_folder)


def _entries(folder: Path, pattern: str, deep: bool = False) -> Iterator[tuple[Path, bool]]:
    try:
        with os.scandir(folder) as listed:
            entries = [(entry.name, entry.is_dir(), entry.is_symlink()) for entry in listed]
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as error:
        raise InputError(f"{folder} cannot be listed ({cause_of(error)}).") from None
    for name, is_folder, is_link in entries:
        if name.startswith(".") or name in _CLUTTER:
            continue
        path = Path(folder) / name
        enters = deep and is_folder and not is_link  # a link may lead back to its folder
        if (fits := fnmatchcase(name, pattern)) or enters:
            try:
                name.encode()
            except UnicodeEncodeError:
                said = f"{folder} holds {name!a}, which is not UTF-8; rename it."
                raise InputError(said) from None
        if fits:
            yield path, is_folder
        if enters:
            yield from _entries(path, pattern, deep)


def check_file(path: Path, most: int = _MOST_BYTES, hint: str = "") -> os.stat_result:
    """Check that a path leads to a regular file of at most `most` bytes, before it is opened.

    Opening a pipe may wait for ever, and a device may have no end. `hint` says what to do.

    Raises:
        InputError: it is missing, another kind of thing, or larger.
    """
    try:
        status = Path(path).stat()
    except OSError as error:
        raise _unread(path, cause_of(error), hint) from None
    if not stat.S_ISREG(status.st_mode):
        is_folder = stat.S_ISDIR(status.st_mode)
        raise _unread(path, "it is a folder" if is_folder else "it is a pipe or a device", hint)
    if status.st_size > most:
        raise _unread(path, f"it has {status.st_size} bytes, expected at most {most}", hint)
    return status


def read_bytes(path: Path, most: int = _MOST_BYTES, hint: str = "") -> bytes:
    """Read a file that `check_file` finds in order."""
    check_file(path, most, hint)
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise _unread(path, cause_of(error), hint) from None


def _unread(path: Path | str, reason: str, hint: str = "") -> InputError:
    return InputError(f"{path} cannot be read ({reason}){'; ' if hint else ''}{hint}.")


def read_text(path: Path, most: int = _MOST_TEXT, hint: str = "") -> str:
    """Read a text in UTF-8, without a byte order mark; lines end with a line feed."""
    try:
        text = read_bytes(path, most, hint).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise _unread(path, str(error), hint or "save it as UTF-8") from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_json(path: Path, most: int = _MOST_TEXT, hint: str = "", is_text: bool = True) -> Any:
    """Read a JSON file; with `is_text`, strings that cannot be written are refused."""
    try:
        content = read_bytes(path, most, hint)
        found = json.loads(content)
        if is_text and re.search(rb"\\u[dD]", content):  # half a character could not be written
            json.dumps(found, ensure_ascii=False).encode()
        return found
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        advice = hint or "it may be truncated"
        raise InputError(f"{path.name} is not JSON ({error}); {advice}.") from None


def read_table(path: Path, hint: str = "", **dialect: Any) -> list[list[str]]:
    """Read the rows of a text table; `dialect` holds options of `csv.reader`, such as a tab."""
    try:
        return list(csv.reader(io.StringIO(read_text(path, hint=hint)), **dialect))
    except csv.Error as error:
        raise _unread(path, str(error), hint) from None


def read_arrays(path: Path, hint: str = "", only: Collection[str] = ()) -> dict[str, Any]:
    """Read the arrays of an .npz by name, all or `only` these, or that of an .npy, named "".

    They hold no Python objects, which could run code.

    Raises:
        InputError: the file cannot be read; `hint` says what it is.
    """
    import numpy as np  # here, because some commands do not need it

    size = check_file(path, sys.maxsize, hint).st_size
    try:
        with warnings.catch_warnings(action="ignore"):  # of Python, about damaged headers
            found = np.load(path, allow_pickle=False)
        if isinstance(found, np.ndarray):
            return {"": found}
        with found:
            if sum(each.file_size for each in found.zip.infolist()) > max(size, _MOST_BYTES):
                raise ValueError("it has more than 2 GB")
            return {name: found[name] for name in only or found if name in found}
    except OSError as error:
        raise _unread(path, cause_of(error), hint) from None
    except Exception as error:  # NumPy parses headers as Python: the type depends on the damage
        reason = ascii(cause_of(error))[1:-1]
        if "pickle" in reason:  # NumPy says how to load it all the same
            reason = "it holds no arrays, or Python objects"
        raise _unread(path, reason, hint) from None


def open_hdf5(path: Path, whole: bool = False) -> "h5py.File":
    """Open an HDF5 file for reading; use it, and read from it, within `reading`.

    `whole` says that no program writes to such files in place, as `write_whole` does not: they are
    read without locks, which many network folders lack. Other files are read without only where
    the file system has none.
    """
    import h5py  # here, because few commands need it

    check_file(path, sys.maxsize)
    try:
        return h5py.File(path, "r", locking=False if whole else None)
    except OSError as error:
        if error.errno not in ([None] if whole else _NO_LOCKS):
            raise
    # Not damaged, if locks show that another program is writing to it.
    return h5py.File(path, "r", locking=None if whole else False)


@contextlib.contextmanager
def reading(
    path: Path, says: str = " cannot be read", then: str = ".", kind: type[InputError] = InputError
) -> Iterator[None]:
    """Raise an error of damage, of any type, as `<path><says> (<reason>)<then>`.

    Errors of the system, such as of permissions, have a sentence of their own: what `then` advises
    may be to delete the file.
    """
    try:
        yield
    except MemoryError:
        raise _unread(path, "it needs more memory than is free, or is damaged") from None
    except Exception as error:
        if isinstance(error, InputError) and str(path) in str(error):
            raise
        if isinstance(error, OSError) and error.errno is not None:
            raise _unread(error.filename or path, cause_of(error)) from None
        raise kind(f"{path}{says} ({cause_of(error)}){then}") from None


def is_name(text: Any) -> bool:
    """Test whether a value is a short, printable string that can be one component of a path."""
    return (
        isinstance(text, str)
        and 0 < len(text) <= _LONGEST_NAME
        and text.isprintable()
        and text not in (".", "..")
        and "/" not in text
    )


def file_name_of(label: str) -> str:
    """Name of a file for any label: one path component, another for every label.

    Example:

        >>> file_name_of("night stand"), file_name_of("tv/stereo")
        ('night stand', 'tv_stereo-b599a4')
    """
    name = "".join(c if c.isprintable() and c not in '/\\<>:"|?*' else "_" for c in label)
    cut = name.strip(". ").encode("utf-8", "replace")[:_LONGEST_NAME]
    name = cut.decode("utf-8", "ignore") or "_"
    # Labels that differ only in what was replaced keep names that differ.
    return name if name == label else f"{name}-{hashlib.sha256(label.encode()).hexdigest()[:6]}"


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
