"""The command `make-homes`."""


def test_command_writes_into_an_empty_folder(tmp_path, cli):
    result = cli("make-homes", tmp_path, "--rooms", 3, "--room-type", "living", "--seed", 3)
    assert result.exit_code == 0, result.output
    assert "3 living rooms" in result.output
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["3D-FRONT", "3D-FUTURE-model", "splits"]
