"""Files are whole or absent, whatever fails on the way."""

import errno
import os
import subprocess
import sys

import numpy as np
import pytest
from mutating import damaged_bytes
from refusals import refused

from sceneprior.core import files
from sceneprior.core.errors import InputError
from sceneprior.core.files import (
    PART,
    check_writable,
    only_writer,
    read_arrays,
    remove_parts,
    write_whole,
)


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
    own = ["deep/part", f"deep/video.mp4{PART}", f"thesis{PART}", f"x.12{PART}", "z.partly"]
    for name in (*own, f"x.1234abcd{PART}", f"deep/y.h5.98765432{PART}"):
        (tmp_path / name).touch()
    remove_parts(tmp_path)
    left = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert sorted(path.relative_to(tmp_path).as_posix() for path in left) == own


def test_a_second_writer_is_refused(tmp_path):
    code = (
        "import sys, time\nfrom pathlib import Path\n"
        "from sceneprior.core.files import only_writer\n"
        "with only_writer(Path(sys.argv[1])):\n    print('on', flush=True)\n    time.sleep(400)"
    )
    folder = tmp_path / "deep" / "run"
    first = subprocess.Popen([sys.executable, "-c", code, folder], stdout=subprocess.PIPE)
    try:
        assert first.stdout.readline() == b"on\n"
        with refused("core/another writer", tmp=tmp_path), only_writer(folder):
            pass
    finally:
        first.kill()
        first.communicate()
    with only_writer(folder):  # what a killed process held is free
        pass
    assert folder.is_dir()  # it was there before


def test_a_folder_made_to_be_locked_goes_again_unless_something_lies_in_it(tmp_path):
    with only_writer(tmp_path / "a" / "b"):
        assert (tmp_path / "a" / "b").is_dir()
    assert not list(tmp_path.iterdir())
    with only_writer(tmp_path / "a" / "b"):
        (tmp_path / "a" / "b" / "file").touch()
    assert (tmp_path / "a" / "b" / "file").is_file()


def test_whether_a_place_can_be_written_is_found_without_a_trace(tmp_path, monkeypatch):
    check_writable(tmp_path / "new" / "scores.json")
    check_writable(tmp_path)
    assert not list(tmp_path.iterdir())

    def read_only(*_):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(files.Path, "write_bytes", read_only)
    with pytest.raises(OSError, match="Read-only") as error:
        check_writable(tmp_path / "new" / "scores.json")
    assert error.value.filename == str(tmp_path / "new" / "scores.json")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "save"), [("a.npy", np.save), ("a.npz", np.savez_compressed)])
def test_damaged_arrays_are_read_or_refused_in_one_sentence(tmp_path, name, save):
    path, values = tmp_path / name, np.arange(12.0).reshape(3, 4)
    save(path, values)
    (found,) = read_arrays(path).values()
    np.testing.assert_array_equal(found, values)
    assert read_arrays(path, only=["b"]).keys() <= {""}
    whole, refusals = path.read_bytes(), set()
    for case in range(300):
        path.write_bytes(damaged_bytes(whole, np.random.default_rng(case)))
        try:
            read_arrays(path, "write it again")
        except InputError as error:
            refusals.add(str(error))
    assert len(refusals) > 5
    for text in refusals:
        assert text.startswith(f"{path} cannot be read (") and text.endswith("; write it again.")
        assert text.isprintable() and len(text) < 350 + len(str(path))
