"""README's two commands, the tutorial's steps as they are printed, and the list of all commands."""

import importlib.util
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def commands_under(page: str, heading: str) -> list[str]:
    """The commands of a section's first block, a line each."""
    section = (ROOT / page).read_text().split(f"\n## {heading}\n")[1].split("\n## ")[0]
    block = re.search(r"```bash\n(.*?)```", section, re.DOTALL)
    assert block is not None
    lines = block[1].replace("\\\n", "").splitlines()
    return [line.split("#")[0].strip() for line in lines if line.strip()]


@pytest.mark.slow
def test_steps_run_as_printed(tmp_path):
    commands = commands_under("docs/tutorial.md", "2. Try the package on rooms that it makes")
    for command in commands:
        program, *arguments = shlex.split(command)
        assert program == "sceneprior"
        done = subprocess.run(
            [sys.executable, "-m", "sceneprior", *arguments],
            cwd=tmp_path, capture_output=True, text=True, timeout=1800,
        )  # fmt: skip
        assert done.returncode == 0, f"{command}\n{done.stderr[-2000:]}"
    made = tmp_path / "out/small"
    assert len(list((made / "scenes").glob("*.glb"))) == 4
    assert (made / "scenes/rooms.html").is_file()
    assert (made / "run/report.html").read_text().startswith("<!doctype html>")
    assert (made / "views.png").stat().st_size > 10_000


def test_every_command_is_in_the_reference():
    """The page that the site makes from the commands' help has each, with what it does."""
    pytest.importorskip("mkdocs", reason="no mkdocs here: pip install -e '.[docs]'")
    from typer.main import get_command

    from sceneprior.apps.cli.commands import app

    spec = importlib.util.spec_from_file_location("hooks", ROOT / "docs/hooks.py")
    assert spec is not None and spec.loader is not None
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    page = hooks.commands_page()
    told = dict(re.findall(r"^## `sceneprior ([a-z-]+)`\n\n(.+)$", page, re.MULTILINE))
    assert set(told) == set(get_command(app).commands)
    assert all(words.endswith((".", ":")) and len(words) > 20 for words in told.values()), told
