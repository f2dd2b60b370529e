"""The entry point of `sceneprior`: reports failures in one sentence, and handles Ctrl-C.

`main` imports the commands (commands.py) itself, so that Ctrl-C is handled during the import.
"""

import errno
import os
import sys
from typing import NoReturn

from sceneprior.apps.cli.interrupts import answering_ctrl_c
from sceneprior.apps.cli.messages import warnings_as_sentences

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


def main() -> None:
    """Run the command; an error in the input prints one sentence and exits with status 2."""
    with answering_ctrl_c() as was_pressed:
        try:
            from sceneprior.apps.cli.commands import app

            with warnings_as_sentences():
                app()
        except SystemExit as ended:
            # After Ctrl-C, Typer exits with status 130 and prints nothing.
            if ended.__context__ and isinstance(ended.__context__.__cause__, KeyboardInterrupt):
                _stopped()
            raise
        except KeyboardInterrupt:
            _stopped()
        except Exception as error:
            if was_pressed():
                _stopped()  # some libraries turn the KeyboardInterrupt into another error
            _failed(error)


def _stopped() -> NoReturn:
    print("Stopped by Ctrl-C. No file is left half-written.", file=sys.stderr)
    sys.exit(130)


def _failed(error: Exception) -> NoReturn:
    from sceneprior.core.errors import InputError

    if isinstance(error, InputError | FloatingPointError):
        print(f"Error: {error}", file=sys.stderr)
        sys.exit(2)
    if isinstance(error, OSError) and error.errno in _ADVICE:
        print(
            f"Error: {error.filename or 'A file'} cannot be read or written ({error.strerror}); "
            f"{_ADVICE[error.errno]}.",
            file=sys.stderr,
        )
        sys.exit(2)
    if os.environ.get("SCENEPRIOR_DEBUG"):
        raise error
    print(
        f"Error: {type(error).__name__}: {error}\nThis should not happen. Run again with "
        "SCENEPRIOR_DEBUG=1 for the traceback, and please report it.",
        file=sys.stderr,
    )
    sys.exit(1)
