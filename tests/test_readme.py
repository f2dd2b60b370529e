"""README: its steps run as they are printed, in an empty folder; its table has every command."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def readme_commands(heading: str) -> list[str]:
    """The commands of a section's first block, a line each."""
    text = (ROOT / "README.md").read_text()
    section = text.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    block = re.search(r"```bash\n(.*?)```", section, re.DOTALL)
    assert block is not None
    lines = block[1].replace("\\\n", "").splitlines()
    return [line.split("#")[0].strip() for line in lines if line.strip()]


@pytest.mark.slow
def test_steps_run_as_printed(tmp_path):
    for command in readme_commands("Step by step"):
        program, *arguments = shlex.split(command)
        assert program == "sceneprior"
        done = subprocess.run(
            [sys.executable, "-m", "sceneprior", *arguments],
            cwd=tmp_path, capture_output=True, text=True, timeout=600,
        )  # fmt: skip
        assert done.returncode == 0, f"{command}\n{done.stderr[-2000:]}"
    made = tmp_path / "out/small"
    assert len(list((made / "scenes").glob("*.glb"))) == 4
    assert (made / "run/report.html").read_text().startswith("<!doctype html>")
    assert (made / "views.png").stat().st_size > 10_000


def test_two_commands_are_targets_of_the_makefile():
    makefile = (ROOT / "Makefile").read_text()
    commands = readme_commands("Two commands")
    assert commands == ["make demo", "make test"]
    for command in commands:
        assert f"\n{command.split()[1]}: setup\n" in makefile


def test_every_command_is_in_the_table():
    from typer.main import get_command

    from sceneprior.cli import app

    text = (ROOT / "README.md").read_text()
    named = set(re.findall(r"^\| `([a-z-]+)` \|", text, re.MULTILINE))
    assert named == set(get_command(app).commands)
