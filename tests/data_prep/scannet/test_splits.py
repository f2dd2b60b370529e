"""Scan folders and the official lists."""

import pytest

from data_prep.readers.scannet.splits import find_scans, split_scans
from sceneprior.core.errors import InputError


@pytest.fixture
def scans(tmp_path):
    for name in ("scene0001_00", "scene0000_01", "scene0000_00", "notes", "scene0002_00"):
        (tmp_path / "scans" / name).mkdir(parents=True)
    (tmp_path / "scans" / "mine").mkdir()
    (tmp_path / "scans" / "mine" / "mine.sens").touch()
    (tmp_path / "scans" / "scene0009_00").touch()  # a file is no scan
    return tmp_path / "scans"


def lists(tmp_path, train, val):
    for name, text in (("train.txt", train), ("val.txt", val)):
        (tmp_path / name).write_text(text)
    return tmp_path / "train.txt", tmp_path / "val.txt"


def test_the_lists_decide_and_the_rest_is_named(scans, tmp_path):
    train, val = lists(tmp_path, "scene0000_01\nscene0000_00\nscene0700_00\n\n", "scene0001_00\r\n")
    split_of, missing = split_scans(find_scans(scans), train, val)
    assert split_of == {
        "scene0000_00": "train", "scene0000_01": "train", "scene0001_00": "test",
    }  # fmt: skip
    assert list(split_of) == sorted(split_of) and missing == ["scene0700_00"]
    assert split_scans(find_scans(scans), None, val)[0] == {"scene0001_00": "test"}


def test_lists_that_are_none(scans, tmp_path):
    folders = find_scans(scans)
    with pytest.raises(InputError, match=r"scene0000_00 is in both .*train\.txt and .*val\.txt"):
        split_scans(folders, *lists(tmp_path, "scene0000_00", "scene0000_00"))
    said = r"None of the 5 scans is in .*train\.txt and .*val\.txt; check that --train-list and"
    with pytest.raises(InputError, match=said):
        split_scans(folders, *lists(tmp_path, "scene0700_00", ""))
    with pytest.raises(InputError, match="None of the 5 scans is in a list, as no list is given"):
        split_scans(folders)
    with pytest.raises(InputError, match=r"train\.txt, line 2: 'scene0000_00,train' is not a scan"):
        split_scans(folders, *lists(tmp_path, "\nscene0000_00,train", ""))
    with pytest.raises(InputError, match=r"The list of scans .*none\.txt cannot be read"):
        split_scans(folders, tmp_path / "none.txt")


def test_folders_that_are_none(scans, tmp_path):
    with pytest.raises(InputError, match=r"No folder at .*none; --scans names"):
        find_scans(tmp_path / "none")
    with pytest.raises(InputError, match=r"holds no scans .*; did you mean .*/scans\?"):
        find_scans(tmp_path)
    with pytest.raises(InputError, match=r"holds no scans .*; did you mean .*/scans\?"):
        find_scans(scans / "scene0000_00")
    with pytest.raises(InputError, match=r"holds no scans .scene0000_00/ and so on.\."):
        find_scans(scans / "notes")
