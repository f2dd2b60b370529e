"""Helpers for tests of commands: sentences on the error stream, and unchanged folders."""

from pathlib import Path
from typing import Any

from refusals import refused

from sceneprior.core.errors import InputError


def one_sentence(result: tuple[int, str, str]) -> str:
    """The whole story on one line of stderr, status 2, no traceback; the sentence itself."""
    status, _, errors = result
    assert status == 2, errors
    lines = errors.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("Error: "), errors
    assert "Traceback" not in errors and lines[0].count("Error:") == 1
    assert lines[0][-1] in ".!" and len(lines[0]) > 40
    return lines[0]


def refuses(command: Any, key: str, *arguments: object, **hidden: object) -> None:
    """A command ends with one sentence, which is `key` of the golden file; see `refused`."""
    said = one_sentence(command(*arguments)).removeprefix("Error: ")
    with refused(key, **hidden):
        raise InputError(said)


def everything_in(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b""
        for path in folder.rglob("*")
    }
