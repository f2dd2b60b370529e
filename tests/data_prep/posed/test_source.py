"""Posed rooms through the engine and the command: splits, sizes, failures, assumptions."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from posed_files import PosedRoom, furniture
from tiny_runs import tiny_config

from data_prep.engine.build import Job, build_shards
from data_prep.engine.source import RoomTask
from data_prep.engine.workers import pool
from data_prep.readers.posed.source import PosedSource, find_rooms
from data_prep.readers.posed.views import PosedSettings
from sceneprior.core.dataset import ViewDataset
from sceneprior.core.errors import InputError
from sceneprior.core.ground_truth import reference_scenes

SET = "void,bed,chair"


@pytest.fixture
def rooms(tmp_path):
    """Four rooms."""
    return [
        PosedRoom(tmp_path / "rooms" / f"room_{k}", furniture(0.05 * k)).write(
            floor_m=0.0, floor_center_m=[0.0, 0.0], metres_per_unit=1.0
        )
        for k in range(4)
    ]


@pytest.fixture
def source(rooms, tmp_path):
    return PosedSource(tmp_path / "rooms", SET)


def survey(source):
    with pool(1) as run:
        return source.survey(run)


def test_shards_of_ones_own_classes_can_be_trained_on(source, tmp_path):
    summary = build_shards(Job(source, tmp_path / "shards"))
    assert summary.statuses == {"prepared": 4}
    assert summary.counts["train"]["rooms"] == 3 and summary.counts["test"]["rooms"] == 1
    assert summary.report["classes"] == {"bed": 4, "chair": 4}
    data = ViewDataset(tmp_path / "shards", "train", views_per_room=2, mask_step=4)
    assert data.label_set == SET == tiny_config(tmp_path, label_set=SET).label_set
    batch = data.__getitems__([(0, 0), (1, 0)])
    assert batch.object_class.tolist() == [[1, 2], [1, 2]]
    with pytest.raises(InputError, match="carries no 3D ground truth, which this evaluation"):
        reference_scenes(tmp_path / "shards", "test")


def test_splits_are_seeded_shares_of_rooms(source):
    everything = survey(PosedSource(source.folder, SET, test_share=0.0)).rooms
    assert {room.split for room in everything} == {"train"} and len(everything) == 4
    for share in (-0.1, 1.0, float("nan")):
        with pytest.raises(
            InputError, match=r"test_share is .*; expected a share from 0 to below 1"
        ):
            PosedSource(source.folder, SET, test_share=share).settings(None)


def test_one_room_is_a_folder_of_rooms(source, rooms, tmp_path, monkeypatch):
    monkeypatch.chdir(rooms[1].folder)
    summary = build_shards(Job(PosedSource(rooms[1].folder, SET), tmp_path / "out"))
    assert summary.counts["train"]["rooms"] == 1 and summary.statuses == {"prepared": 1}
    assert [room.room_id for room in survey(PosedSource(Path(), SET)).rooms] == ["room_1"]
    assert find_rooms(source.folder) == [room.folder for room in rooms]
    with pytest.raises(InputError, match=r"No folder at .*; prep-posed reads a folder of rooms"):
        find_rooms(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"holds no poses of nerfstudio .*\(unpack \.zip and"):
        find_rooms(tmp_path / "empty")


def test_rooms_of_another_size_are_left_out_with_the_reason(source, rooms):
    PosedRoom(rooms[2].folder, size=(128, 96)).write()
    found = survey(source)
    assert [room.room_id for room in found.rooms] == ["room_0", "room_1", "room_3"]
    (left,) = found.left_out
    assert (left.room_id, left.status, left.rule) == ("room_2", "filtered", "image_size")
    assert left.reason.startswith(
        "its views are 96 x 128 pixels, those of most rooms 128 x 96, and"
    )
    with pytest.raises(
        InputError, match=r"for --only room_2 .1 were left out; the most frequent reason"
    ):
        survey(PosedSource(source.folder, SET, only="room_2"))
    (alone,) = survey(PosedSource(rooms[2].folder, SET)).rooms
    assert alone.room_id == "room_2"


def test_settings_follow_the_files(source, rooms):
    before = source.settings(None)
    assert json.loads(json.dumps(before)) == before
    changed = PosedSource(source.folder, SET, PosedSettings(max_side=64)).settings(None)
    assert [key for key in before if before[key] != changed[key]] == ["recipe"]
    for path in (rooms[0].png(2), rooms[0].folder / "classes.json"):
        now = source.settings(None)
        path.write_bytes(path.read_bytes() + b" ")
        assert source.settings(None)["rooms"] != now["rooms"]


def test_damaged_rooms_are_named_and_the_rest_goes_on(source, rooms, tmp_path):
    (rooms[0].folder / "transforms.json").write_text("{")
    whole = rooms[1].png(3).read_bytes()
    rooms[1].png(3).write_bytes(whole[:60])
    (rooms[2].folder / "transforms.json").unlink()
    job = Job(PosedSource(source.folder, SET, test_share=0.0), tmp_path / "out")
    summary = build_shards(job)
    assert summary.statuses == {"prepared": 1, "failed": 3}
    reasons = {line["room_id"]: line["reason"] for line in summary.report["failed"]}
    assert "transforms.json is not JSON" in reasons["room_0"]
    assert "frame_00003.png is " in reasons["room_1"]
    assert "transforms.json cannot be read (No such file" in reasons["room_2"]


def test_a_room_that_goes_away_meanwhile(source, tmp_path):
    with pytest.raises(InputError, match="rooms no longer has this room; restore"):
        source.prepare(RoomTask("attic", "attic", "train"), None)


def test_assumptions_are_said_before_the_work(source, rooms):
    assert source.assumptions() == []
    rooms[0].write()
    rooms[1].write(floor_m=0.0)
    said = PosedSource(source.folder, SET, PosedSettings(up="y")).assumptions()
    assert said[0].startswith(
        "1 of 4 rooms give no floor_m: the floor is estimated from the lowest"
    )
    assert said[1].startswith(
        "2 of 4 rooms give no metres_per_unit: poses are assumed to be in metres,"
    )
    assert said[2] == (
        "In 4 of 4 rooms the tops of the pictures point along z, but y is taken as up; should "
        "it be --up z?"
    )
    told = PosedSettings(floor_m=0.0, metres_per_unit=0.5)
    assert PosedSource(source.folder, SET, told).assumptions() == []


def test_a_room_that_shows_nothing_is_filtered(source, rooms, tmp_path):
    for view in range(5):
        Image.fromarray(np.zeros((96, 128), dtype=np.uint8)).save(rooms[1].png(view))
    summary = build_shards(Job(source, tmp_path / "out"))
    (line,) = (line for line in summary.lines if line.room_id == "room_1")
    assert (line.status, line.rule) == ("filtered", "no_view")
    assert line.reason == "none of its 5 frames shows any object"


def test_the_command(rooms, tmp_path, cli):
    rooms[0].write()
    made = cli(
        "prep-posed", tmp_path / "rooms", "--out", tmp_path / "shards", "--label-set", SET,
        "--max-side", 64, "--workers", 1, "--test-share", 0.25,
    )  # fmt: skip
    assert made.exit_code == 0, made.output
    assert "Note: 1 of 4 rooms give no floor_m" in made.stderr
    assert "train 3 rooms, 15 views" in made.stdout
    assert json.loads((tmp_path / "shards/index.json").read_text())["label_set"] == SET
    looked = cli("inspect", tmp_path / "shards", "--room", "room_0")
    assert looked.exit_code == 0 and "unknown" in looked.stdout, looked.output
    checked = cli("inspect", tmp_path / "shards", "--verify")
    assert checked.exit_code == 0, checked.output
    assert "nothing wrong is found, but little is checked. " in " ".join(checked.stdout.split())
    rooms[2].png(0).unlink()
    again = cli(
        "prep-posed", tmp_path / "rooms", "--out", tmp_path / "shards", "--label-set", SET,
        "--max-side", 64, "--workers", 1, "--test-share", 0.25,
    )  # fmt: skip
    assert "was begun with other settings (rooms differ)" in str(again.exception)


def test_only(source):
    one = PosedSource(source.folder, SET, only="room_3")
    assert [room.room_id for room in survey(one).rooms] == ["room_3"]
    with pytest.raises(InputError, match=r"has no room 'attic' .--only takes a room's folder.\."):
        source.settings("attic")
