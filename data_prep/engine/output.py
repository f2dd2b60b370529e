"""Guards the folder that a job writes: one run at a time, and a sentence if writing fails."""

import contextlib
import errno
from collections.abc import Iterator
from pathlib import Path

from sceneprior.errors import InputError
from sceneprior.files import only_writer, remove_parts

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextlib.contextmanager
def claimed(out: Path) -> Iterator[None]:
    """Be the only run that writes to `out`; begin without the leftovers of a killed one.

    Folders made for this go again if nothing came to lie in them.

    Raises:
        InputError: another run writes there, or it cannot be written.
    """
    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    try:
        with contextlib.ExitStack() as until_done:
            with writing(out):
                until_done.enter_context(only_writer(out))
                remove_parts(out)
            yield
            with writing(out):
                remove_parts(out)  # of workers that died on the way
    finally:
        with contextlib.suppress(OSError):
            for folder in made:
                folder.rmdir()


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
