"""Guards the output folder of a job: one run at a time, readable errors if writing fails."""

import contextlib
import errno
from collections.abc import Iterator
from pathlib import Path

from sceneprior.core.errors import InputError
from sceneprior.core.files import only_writer, remove_parts

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextlib.contextmanager
def claimed(out: Path) -> Iterator[None]:
    """Lock `out` for this run, and remove the partial files of a killed run."""
    with contextlib.ExitStack() as until_done:
        with writing(out):
            until_done.enter_context(only_writer(out))
            remove_parts(out)
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                remove_parts(out)  # partial files of workers that died


@contextlib.contextmanager
def writing(out: Path, what: str = "") -> Iterator[None]:
    """Turn an OSError into an InputError that names the lost work, `what`, and how to continue."""
    try:
        yield
    except OSError as error:
        where = error.filename or out
        about = f" ({what})" if what else ""
        advice = "free space on the disk and " if error.errno in _FULL else ""
        raise InputError(
            f"{where}{about} cannot be written ({error.strerror or error}). "
            f"Finished shards are kept: {advice}run the same command again to continue."
        ) from None
