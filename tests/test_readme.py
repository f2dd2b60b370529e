"""The tutorial's steps on rooms that the package makes, as they are printed."""

import subprocess
import sys

import pytest
from pages import ROOT, commands_of


@pytest.mark.slow
def test_steps_run_as_printed(tmp_path):
    heading = "\n## 2. Try the package on rooms that it makes\n"
    section = (ROOT / "docs/tutorial.md").read_text().split(heading)[1]
    for program, *arguments in commands_of(section.split("```bash\n")[1].split("```")[0]):
        assert program == "sceneprior"
        done = subprocess.run(
            [sys.executable, "-m", "sceneprior", *arguments],
            cwd=tmp_path, capture_output=True, text=True, timeout=1800,
        )  # fmt: skip
        assert done.returncode == 0, f"{arguments}\n{done.stderr[-2000:]}"
    made = tmp_path / "out/small"
    assert len(list((made / "scenes").glob("*.glb"))) == 4
    assert (made / "scenes/rooms.html").is_file()
    assert (made / "run/report.html").read_text().startswith("<!doctype html>")
    assert (made / "views.png").stat().st_size > 10_000
