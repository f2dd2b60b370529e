"""Trips through the code, each with the number of files that a reader passes on it.

A file counts if one of its functions is called on the way; a prior and what a process keeps are
loaded before. `python -m pytest -s tests/test_trips.py` prints the files of every trip.
"""

import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from scan_files import make_scan, write_table
from tiny_runs import tiny_config

import sceneprior
from data_prep.engine.build import Job, build_shards
from data_prep.readers.scannet import ScanNet
from sceneprior.training.steps import make_loader

ROOT = Path(__file__).parents[1]
OURS = (f"{ROOT}/sceneprior/", f"{ROOT}/data_prep/")


def files_of(trip: Callable[[], Any]) -> list[str]:
    """Our files with a function that is called while `trip` runs; imports do not count."""
    found = set()

    def note(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event == "call" and code.co_name != "<module>" and code.co_filename.startswith(OURS):
            found.add(code.co_filename.removeprefix(f"{ROOT}/"))

    before = sys.getprofile()
    threading.setprofile(note)
    sys.setprofile(note)
    try:
        trip()
    finally:
        sys.setprofile(before)
        threading.setprofile(None)  # type: ignore[arg-type]
    return sorted(found)


@pytest.fixture(scope="module")
def prior():
    prior = sceneprior.load("demo-bedroom")
    prior.sample(1)
    return prior


def test_a_mask_to_its_gradient(toy_shards, monkeypatch):
    """A step of the paper's second stage, from its shards."""
    config = tiny_config(toy_shards)
    monkeypatch.setattr("sceneprior.paper.stages.log_losses", lambda *_: None)
    stage = next(each for each in config.stages() if each.name == "shape")

    def trip() -> None:
        data = stage.open_data()
        module = stage.build(data, None)
        views = next(iter(make_loader(data, config.shape.batch_size, 0, 0)))
        module.training_step(views, 0).backward()

    assert_short(files_of(trip), 25)


def test_a_drawn_room_to_its_glb(prior, tmp_path):
    room = tmp_path / "room.glb"
    assert_short(files_of(lambda: sceneprior.save(prior.sample(1)[0], room)), 30)


def test_a_wish_to_an_answer(prior):
    assert_short(files_of(lambda: prior.sample(1, want="two nightstands")), 36)


def test_a_recording_to_a_shard(tmp_path):
    """One scan of ScanNet, as `prep-scannet` prepares it."""
    make_scan(tmp_path / "scans" / "scene0000_00").write(mask_size=(242, 324))
    labels = write_table(tmp_path / "labels.tsv")
    source = ScanNet(tmp_path / "scans", labels=labels, frame_step=1)
    assert_short(files_of(lambda: build_shards(Job(source, tmp_path / "shards"))), 20)


def assert_short(files: list[str], most: int) -> None:
    print(len(files), *files, sep="\n  ")
    assert len(files) <= most, files
