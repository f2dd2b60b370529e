"""Errors shown to users, and what commands say of failures: what was expected, what was given, and
what to do."""

import errno

_ADVICE = {
    errno.ENOSPC: "free space on its disk, or name another folder",
    errno.EDQUOT: "free space in your quota, or name another folder",
    errno.EFBIG: "its disk, or `ulimit -f`, allows no file of this size",
    errno.EROFS: "name a folder that can be written",
    errno.EACCES: "change its permissions, or name another folder",
    errno.EPERM: "change its permissions, or name another folder",
    errno.ENOENT: "check the path, or name another folder",
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


class InputError(ValueError):
    """The user's input cannot be used; the message is self-contained.

    The CLI prints the message and exits with status 2, without a traceback.
    """


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
    if isinstance(error, OSError) and error.errno in _ADVICE:
        return (
            f"{error.filename or 'A file'} cannot be read or written ({error.strerror}); "
            f"{_ADVICE[error.errno]}."
        )
    return None
