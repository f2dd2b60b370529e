"""The command `make-homes`."""

import typer
from typer.testing import CliRunner

from data_prep.cli import make_homes


def test_command_writes_into_an_empty_folder(tmp_path):
    app = typer.Typer()
    app.command()(make_homes)
    arguments = [str(tmp_path), "--rooms", "3", "--room-type", "living", "--seed", "3"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "3 living rooms" in result.output
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["3D-FRONT", "3D-FUTURE-model", "splits"]
