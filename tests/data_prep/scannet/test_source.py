"""ScanNet through the engine: splits, the report's lines, failures that leave the rest alone."""

import json

import numpy as np
import pytest
from scan_files import make_scan, write_table

from data_prep.engine.build import Job, build_shards
from data_prep.engine.source import Line, RoomTask
from data_prep.engine.workers import pool
from data_prep.readers.scannet.scans import ScanSettings
from data_prep.readers.scannet.source import ScanNetSource
from sceneprior.core.errors import InputError
from sceneprior.core.shards import iterate_rooms

IDS = ["scene0000_00", "scene0000_01", "scene0001_00", "scene0002_00"]


@pytest.fixture
def source(tmp_path):
    for scan_id in IDS:
        make_scan(tmp_path / "scans" / scan_id).write(mask_size=(242, 324))
    table = write_table(tmp_path / "labels.tsv")
    return ScanNetSource(tmp_path / "scans", table, ScanSettings(frame_step=1))


def listed(source, train, val):
    folder = source.scans.parent
    for name, ids in (("train.txt", train), ("val.txt", val)):
        (folder / name).write_text("\n".join(ids) + "\n")
    return ScanNetSource(
        source.scans, source.labels, source.scan_settings, folder / "train.txt", folder / "val.txt"
    )


def survey(source):
    with pool(1) as run:
        return source.survey(run)


def test_lists_become_splits_and_the_rest_is_counted(source):
    official = listed(source, [IDS[0], IDS[1], "scene0700_00"], [IDS[3]])
    found = survey(official)
    assert [(room.room_id, room.split) for room in found.rooms] == [
        (IDS[0], "train"), (IDS[1], "train"), (IDS[3], "test"),
    ]  # fmt: skip
    assert [(item.room_id, item.status, item.rule) for item in found.left_out] == [
        (IDS[2], "filtered", "split"), ("scene0700_00", "filtered", "split"),
    ]  # fmt: skip
    assert found.left_out[0].reason == "it is in no list"
    assert "a list names it, but" in found.left_out[1].reason


def test_settings_follow_what_the_bytes_depend_on(source):
    before = source.settings(None)
    assert json.loads(json.dumps(before)) == source.settings(None) | {
        "recipe": {"frame_step": 1, "max_views": 100, "masks": "filt", "image_size": [242, 324]}
    }
    assert listed(source, IDS[:2], IDS[2:]).settings(None) != before
    write_table(source.labels, [("raw_category", "nyu40class"), ("bed", "bed")])
    after = source.settings(None)
    assert [key for key in before if before[key] != after[key]] == ["labels"]
    (source.scans / IDS[0] / f"{IDS[0]}.txt").write_text("")
    assert source.settings(None) == after  # a mended scan may be tried again
    (source.scans / IDS[0]).rename(source.scans / "scene0005_00")
    assert source.settings(None)["scans"] != after["scans"]
    with pytest.raises(InputError, match=r"has no scan 'scene0009_00' .--only takes a scan"):
        source.settings("scene0009_00")


def test_only_is_a_scan_or_the_beginning_of_its_name(source):
    for only, expected in ((IDS[1], [IDS[1]]), ("scene0000", IDS[:2])):
        one = ScanNetSource(source.scans, source.labels, only=only)
        assert [room.room_id for room in survey(one).rooms] == expected


def test_a_scan_that_shows_nothing_is_filtered(source):
    scan = make_scan(source.scans / IDS[0])
    for box in scan.boxes:
        box.category = "backpack"
    scan.write(mask_size=(242, 324))
    out = source.prepare(RoomTask(IDS[0], IDS[0], "train"), None)
    assert isinstance(out, Line) and (out.status, out.rule) == ("filtered", "no_view")
    assert out.reason == "none of its 5 views shows any object"
    assert any("usable pose" in note for note in out.notes)


def test_a_damaged_scan_fails_by_name_and_the_rest_goes_on(source, tmp_path):
    sens = source.scans / IDS[1] / f"{IDS[1]}.sens"
    whole = sens.read_bytes()
    sens.write_bytes(whole[:-60])
    official = listed(source, IDS[:3], IDS[3:])
    summary = build_shards(Job(official, tmp_path / "out"))
    assert summary.statuses == {"prepared": 3, "failed": 1}
    assert summary.counts["train"]["rooms"] == 2 and summary.counts["test"]["views"] == 5
    (failed,) = (room for room in summary.report["rooms"] if room["status"] == "failed")
    assert failed["room_id"] == IDS[1] and f"{IDS[1]}.sens, frame 5, byte" in failed["reason"]
    for split, expected in (("train", [IDS[0], IDS[2]]), ("test", [IDS[3]])):
        rooms = [
            (room_id, shard.read_room(room_id))
            for shard, room_id in iterate_rooms(tmp_path / "out", split)
        ]
        assert [room_id for room_id, _ in rooms] == expected
        assert all(np.array_equal(room.object_class, [2, 5]) for _, room in rooms)
    sens.write_bytes(whole)
    summary = build_shards(Job(official, tmp_path / "out", retry_failed=True))
    assert summary.statuses == {"prepared": 4}
    assert summary.report["counts"]["train"] == {"rooms": 3, "views": 15, "objects": 6}


def test_without_lists_a_space_is_in_one_half(source):
    for seed in range(6):
        rooms = survey(ScanNetSource(source.scans, source.labels, seed=seed)).rooms
        assert [room.room_id for room in rooms] == IDS
        assert rooms[0].split == rooms[1].split
        assert {room.split for room in rooms} == {"train", "test"}
