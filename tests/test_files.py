"""Files are whole or absent, whatever fails on the way."""

import errno
import os

import pytest

from sceneprior import files
from sceneprior.files import PART, remove_parts, write_whole


def test_written_in_new_folders_and_replaced(tmp_path):
    path = tmp_path / "a" / "b" / "file.bin"
    write_whole(path, b"one")
    write_whole(path, b"two")
    assert path.read_bytes() == b"two" and [p.name for p in path.parent.iterdir()] == ["file.bin"]


def test_bytes_texts_and_functions_are_written_alike(tmp_path):
    def write(path):
        assert path.name.endswith(PART)
        path.write_text("ä\n")

    for name, content in {"bytes": "ä\n".encode(), "text": "ä\n", "function": write}.items():
        write_whole(tmp_path / name, content)
        assert (tmp_path / name).read_bytes() == b"\xc3\xa4\n"
    with pytest.raises(ZeroDivisionError):
        write_whole(tmp_path / "text", lambda path: path.write_text("half") / 0)
    assert (tmp_path / "text").read_text() == "ä\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bytes", "function", "text"]


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_what_was_there_stays_if_writing_fails(tmp_path, monkeypatch, step):
    path = tmp_path / "file.bin"
    write_whole(path, b"before")

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(files.os if step == "fsync" else files.Path, step, full)
    with pytest.raises(OSError, match="No space left") as error:
        write_whole(path, b"after")
    assert error.value.filename == str(path)
    assert path.read_bytes() == b"before" and len(list(tmp_path.iterdir())) == 1


def test_leftovers_go_and_nothing_else(tmp_path):
    (tmp_path / "deep").mkdir()
    for name in (f"x.12{PART}", f"deep/y.h5.ab{PART}", "deep/part", "z.partly"):
        (tmp_path / name).touch()
    remove_parts(tmp_path)
    assert sorted(p.name for p in tmp_path.rglob("*") if p.is_file()) == ["part", "z.partly"]
