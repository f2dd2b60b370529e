"""Errors shown to users, and what commands say of failures: what was expected, what was given, and
what to do."""

import errno
import os
import re

_ADVICE = {
    errno.EAGAIN: "another program has it open for writing: wait until it has ended. If none has, "
    "its file system has no locks: set HDF5_USE_FILE_LOCKING=FALSE",
    errno.ENOLCK: "its file system has no locks: set HDF5_USE_FILE_LOCKING=FALSE",
    errno.ELOOP: "a symbolic link leads back to itself; name what it shall lead to",
    errno.ENOSPC: "free space on its disk",
    errno.EDQUOT: "free space in your quota",
    errno.EFBIG: "its disk, or `ulimit -f`, allows no file of this size",
    errno.EROFS: "name a folder that can be written",
    errno.EACCES: "change its permissions",
    errno.EPERM: "change its permissions",
    errno.ENOENT: "check the path",
    errno.ENOTDIR: "a file is where a folder is needed; name another folder",
    errno.EEXIST: "a file is where a folder is needed; name another folder",
    errno.EISDIR: "a folder is where a file is needed; name another file",
    errno.ENOTEMPTY: "another process writes there; name another folder",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.EMFILE: "allow more open files with `ulimit -n 4096`",
    errno.ENFILE: "close other programs: this machine has no more open files",
    errno.EIO: "its disk or network fails; copy it elsewhere, or try again",
    errno.ESTALE: "its network folder was lost; try again",
}
"""Advice on operating system errors, by number."""
_ELSEWHERE = {errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.ENOENT}
"""Errors after which the user may also write to another folder."""
_LONGEST_SENTENCE = 2000


def shortened(said: object, longest: int = 500) -> str:
    """Put a text on one line; cut out the middle of a long text.

    >>> shortened("a" * 60, longest=20)
    'aaaaaaaaaa ... aaaa'
    """
    text = " ".join(str(said).split())
    return text if len(text) <= longest else f"{text[: longest // 2]} ... {text[-longest // 5 :]}"


class InputError(ValueError):
    """The user's input cannot be used; the message is self-contained.

    The CLI prints the message and exits with status 2, without a traceback. A message is cut if it
    quotes too much of the input.
    """

    def __init__(self, sentence: str = ""):
        long = len(sentence) > _LONGEST_SENTENCE
        super().__init__(shortened(sentence, _LONGEST_SENTENCE) if long else sentence)


class ShardError(InputError):
    """A view shard is missing, incomplete or not of this format."""


class ConfigError(InputError):
    """A run's settings cannot be read."""


class InputWarning(UserWarning):
    """A warning about the user's input; commands print the sentence and go on."""


def sentence_of(error: Exception) -> str | None:
    """The failure and what to do about it in one sentence; None if the error is a bug."""
    if isinstance(error, InputError | FloatingPointError):
        return str(error)
    if isinstance(error, OSError) and (error.errno in _ADVICE or error.filename):
        advice = f"; {_ADVICE[error.errno]}" if error.errno in _ADVICE else ""
        other = ", or name another folder" if error.errno in _ELSEWHERE else ""
        return (
            f"{error.filename or 'A file'} cannot be read or written ({error.strerror})"
            f"{advice}{other}."
        )
    return None


def cause_of(error: Exception) -> str:
    """Why a file cannot be read, and what to do: 'Permission denied: change its permissions'."""
    if not isinstance(error, OSError) or error.errno is None:
        # The next sentences of libraries are for those who build them.
        return re.split(r"(?<=\w)\. (?=[A-Z])", shortened(error, 300))[0] or type(error).__name__
    advice = _ADVICE.get(error.errno) if error.errno != errno.ENOENT else None
    return os.strerror(error.errno) + (f": {advice}" if advice else "")
