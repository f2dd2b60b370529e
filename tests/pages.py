"""Pages of the documentation, their fenced blocks, and the commands of these."""

import re
import shlex
from pathlib import Path
from typing import NamedTuple

from typer.testing import CliRunner

from sceneprior.apps.cli.commands import app

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    ROOT / "README.md", ROOT / "configs/README.md", *sorted((ROOT / "docs").rglob("*.md"))
]  # fmt: skip


class Block(NamedTuple):
    """A fenced block of a page."""

    page: Path
    line: int
    language: str
    text: str
    not_run: str
    """Why it is not run; empty where it is."""


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def blocks_of(page: Path) -> list[Block]:
    found, lines = [], page.read_text().splitlines()
    start: int | None = None
    for number, line in enumerate(lines):
        if not line.startswith("```"):
            continue
        if start is None:
            start = number
            continue
        above = re.fullmatch(r"<!-- not run: (.+) -->", lines[start - 1])
        text = "\n".join(lines[start + 1 : number]) + "\n"
        language = lines[start].removeprefix("```").strip()
        found.append(Block(page, start + 1, language, text, above[1] if above else ""))
        start = None
    assert start is None, f"{name_of(page)}:{start}: a fence is not closed"
    return found


def commands_of(text: str) -> list[list[str]]:
    """The words of each command of a shell block, comments and `srun` left out."""
    lines = text.replace("\\\n", " ").replace("&&", "\n").splitlines()
    words = [shlex.split(line, comments=True) for line in lines]
    return [line[1:] if line[0] == "srun" else line for line in words if line]


def first_block(page: Path, language: str) -> str:
    return next(block.text for block in blocks_of(page) if block.language == language)


def run_first_commands(page: Path) -> list[str]:
    """Run the commands of a page's first bash block here; what each printed."""
    said = []
    for command, *words in commands_of(first_block(page, "bash")):
        assert command == "sceneprior"
        done = CliRunner().invoke(app, words)
        assert done.exit_code == 0, f"{words}\n{done.output[-2000:]}\n{done.exception}"
        said.append(done.stdout)
    return said
