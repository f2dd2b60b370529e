"""Warnings of the command line, printed on stderr without source lines."""

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sceneprior.core.errors import InputWarning


def rooms_in_words(count: int) -> str:
    """The number of rooms: `1 room`, `2 rooms`."""
    return "1 room" if count == 1 else f"{count} rooms"


@contextmanager
def warnings_as_sentences() -> Iterator[None]:
    """Print each `InputWarning` without the source line that Python adds."""
    with warnings.catch_warnings():
        show = warnings.showwarning

        def say(message: Warning | str, category: type[Warning], *where: Any, **to: Any) -> None:
            if issubclass(category, InputWarning):
                print(f"Warning: {message}", file=sys.stderr)
            else:
                show(message, category, *where, **to)

        warnings.showwarning = say
        yield
