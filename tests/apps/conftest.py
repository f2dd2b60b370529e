"""Commands in this process."""

import sys

import pytest

from sceneprior.apps import cli


@pytest.fixture
def command(monkeypatch, capsys, tmp_path):
    """Run `sceneprior <arguments>` in this process: (exit status, stdout, stderr)."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["sceneprior", *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as end:
            cli.main()
        output = capsys.readouterr()
        return int(end.value.code or 0), output.out, output.err

    return run
