"""Posed rooms to views: every box where the picture says, whatever the axes, units and lenses."""

import json
import os

import numpy as np
import pytest
from colmap_files import write_colmap
from PIL import Image
from posed_files import SET, PosedRoom, furniture, prepared
from refusals import refused

from data_prep.engine.build import Job, build_shards
from data_prep.engine.source import RoomTask
from data_prep.inspection.verify import array_problems, mask_problems
from data_prep.readers.posed.reader import Posed
from data_prep.readers.posed.recording import frame_intrinsics, room_name, seems_up
from data_prep.readers.posed.transforms import read_recording
from sceneprior.core.classes import label_set

KEYS = {"floor_m": 0.0, "floor_center_m": [0.1, -0.2]}


@pytest.fixture
def room(tmp_path):
    return PosedRoom(tmp_path / "room")


def check(views):
    assert not [*array_problems(views, len(label_set(SET))), *mask_problems(views)]


def eyes_of(views):
    return np.linalg.inv(views.world_to_camera.astype(float))[:, :3, 3]


def test_an_unknown_floor_is_an_assumption_that_is_said(room):
    room.poses = room.poses[:2]  # too few to find it
    made = prepared(room.write(), camera_height_m=1.3)
    why = "too few pieces show where they end"
    assert made.notes[-1] == f"the floor is assumed 1.3 m below the lowest camera ({why})"
    eyes = eyes_of(made.views)
    np.testing.assert_allclose(eyes[:, 1].min(), 1.3, atol=1e-5)  # float32 poses of metres
    middle = (eyes.min(axis=0) + eyes.max(axis=0))[[0, 2]] / 2
    np.testing.assert_allclose(middle, 0, atol=1e-5)
    told = prepared(room, floor_m=-0.1)
    np.testing.assert_allclose(eyes_of(told.views)[:, 1].min(), 1.6, atol=1e-5)
    assert not any("assumed" in note for note in told.notes)


def test_units_stated_in_a_file_win(room):
    one, other = (
        prepared(room.write(**KEYS, metres_per_unit=1.0), metres_per_unit=unit).views
        for unit in (1.0, 9.0)
    )
    np.testing.assert_array_equal(one.world_to_camera, other.world_to_camera)


def test_a_focal_length_may_be_an_angle_and_a_frames_own(room):
    gone = dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "w", "h"))
    views = prepared(room.write(camera_angle_x=float(2 * np.arctan(64 / 80)), **gone)).views
    np.testing.assert_allclose(
        views.intrinsics[0], [[80, 0, 64], [0, 80, 48], [0, 0, 1]], atol=1e-4
    )
    data = room.data
    data["frames"][2]["fl_x"] = 77.0
    room.write_transforms(data)
    assert prepared(room).views.intrinsics[:, 0, 0].tolist() == [80, 80, 77, 80, 80]


def test_frames_poses_and_their_files(room, tmp_path, monkeypatch):
    data = room.data
    data["frames"][1] |= {"file_path": "./train/r_1", "mask_path": "known.png"}
    data["frames"][2] |= {"file_path": "video/frame.0002.PNG"}
    data["frames"][3] |= {"instance_path": "elsewhere/3.png"}
    room.folder.mkdir()
    room.write_transforms(data | {"floor_m": -1, "floor_center_m": [1, 2.5]})
    recording = read_recording(room.folder)
    inside = [str(frame.instances.relative_to(room.folder)) for frame in recording.frames]
    assert inside == [
        "instances/frame_00000.png", "instances/r_1.png", "instances/frame.0002.png",
        "elsewhere/3.png", "instances/frame_00004.png",
    ]  # fmt: skip
    assert recording.frames[1].known == room.folder / "known.png"
    assert recording.frames[0].known is None
    np.testing.assert_array_equal(recording.frames[4].camera_to_world, room.poses[4])
    assert (recording.floor_m, recording.floor_center_m) == (-1.0, (1.0, 2.5))
    assert recording.metres_per_unit is None
    K, size = frame_intrinsics(recording.frames[0], (1, 1))
    assert K.tolist() == [[80, 0, 64], [0, 80, 48], [0, 0, 1]] and size == (96, 128)
    monkeypatch.chdir(tmp_path)
    assert room_name(tmp_path / "a") == "a" and room_name(".") == tmp_path.name


def test_split_files_are_one_room_and_frames_may_lie_in_folders(room):
    whole = prepared(room.write(**KEYS)).views
    data = room.data
    for k, frame in enumerate(data["frames"]):
        frame["file_path"] = f"./{'train' if k < 3 else 'test'}/r_{k % 3}"
        path = room.folder / "instances" / f"{frame['file_path']}.png"
        path.parent.mkdir(exist_ok=True)
        room.png(k).rename(path)
    (room.folder / "transforms.json").unlink()
    for split, part in (("train", slice(0, 2)), ("val", slice(2, 3)), ("test", slice(3, 5))):
        own = {**data, "frames": data["frames"][part]}
        if split != "train":  # each file has a camera of its own, and the room's keys once
            own |= KEYS
        (room.folder / f"transforms_{split}.json").write_text(json.dumps(own))
    order = [3, 4, 0, 1, 2]  # by the files' names: test, train, val
    parts = prepared(room).views
    np.testing.assert_array_equal(parts.world_to_camera, whole.world_to_camera[order])
    np.testing.assert_array_equal(parts.instance_ids, whole.instance_ids[order])


def test_frames_that_cannot_be_used_are_counted(room):
    for k in range(6):
        room.look((2 - 0.1 * k, -1.5, 1.5), (0, 0, 0.3))
    room.write()
    data = room.data
    data["frames"][1]["transform_matrix"][0][3] = float("nan")
    room.write_transforms(data)
    room.png(3).unlink()
    made = prepared(room)
    assert len(made.views.visible) == 9
    assert made.notes[:2] == (
        "1 of 11 frames have no usable pose; skipped", "1 of 11 frames have no mask; skipped",
    )  # fmt: skip
    assert len(prepared(room, max_views=4).views.visible) == 4
    room.poses = [np.full((4, 4), np.nan)]
    assert seems_up(read_recording(room.write().folder)) is None


def test_what_hides_and_what_does_not(room):
    """Void things and unknown pixels take away the clearness of a side; walls do not."""
    room.things = room.things[:1]
    room.write()
    base = room.ids(0)
    rows, columns = np.nonzero(base)
    left = (slice(rows.min(), rows.max() + 1), slice(columns.min() - 9, columns.min()))
    beside = base.copy()
    beside[left] = 9
    Image.fromarray(beside).save(room.png(0))
    for more, clear in (({}, False), ({"9": "vase"}, False), ({"9": "Wall"}, True)):
        (room.folder / "classes.json").write_text(json.dumps({"3": "bed"} | more))
        made = prepared(room)
        assert made.views.sides_clear[0, 0].tolist() == [clear, True, True, True]
        told = "the table of classes does not have (9): void" in " ".join(made.notes)
        assert told == (not more)
    Image.fromarray(base).save(room.png(0))
    known = np.full(room.size, 255, dtype=np.uint8)
    known[left] = 0
    Image.fromarray(known).save(room.folder / "known.png")
    data = room.data
    data["frames"][0]["mask_path"] = "known.png"
    room.write_transforms(data)
    masked = prepared(room).views
    assert masked.sides_clear[0, 0].tolist() == [False, True, True, True]
    np.testing.assert_array_equal(masked.instance_ids[0] == 2, known == 0)
    check(masked)


# -- Folders of rooms ------------------------------------------------------------------------------


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
    return Posed(tmp_path / "rooms", classes=SET)


def survey(source):
    return source.survey()


def test_settings_follow_the_files(source, rooms):
    before = source.settings(None)
    assert json.loads(json.dumps(before)) == before
    changed = Posed(source.folder, classes=SET, max_side=64).settings(None)
    assert [key for key in before if before[key] != changed[key]] == ["recipe"]
    for path in (rooms[0].png(2), rooms[0].folder / "classes.json"):
        now = source.settings(None)
        path.write_bytes(path.read_bytes() + b" ")
        assert source.settings(None)["rooms"] != now["rooms"]


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("classes.json", b"Chair", b"table"),
        ("transforms.json", b"80.0", b"90.0"),
        ("instances/frame_00002.png", b"IEND", b"iEND"),
    ],
)
def test_shards_of_a_file_that_changed_at_the_same_size_are_not_reused(
    source, rooms, tmp_path, name, old, new
):
    job = Job(source, tmp_path / "shards")
    build_shards(job)
    assert build_shards(job).shards_made == 0
    path = rooms[0].folder / name
    path.write_bytes(path.read_bytes().replace(old, new))
    with refused("readers/shards of older files", tmp=tmp_path):
        build_shards(job)


def test_a_room_whose_name_is_not_utf_8_is_to_be_renamed(source, rooms, tmp_path):
    rooms[1].folder.rename(source.folder / os.fsdecode(b"K\xfcche"))
    with refused("readers/name that is not UTF-8", tmp=tmp_path):
        build_shards(Job(source, tmp_path / "shards"))


def test_assumptions_are_said_before_the_work(source, rooms):
    assert source.assumptions() == []
    rooms[0].write()
    rooms[1].write(floor_m=0.0)
    write_colmap(rooms[2], "PINHOLE", binary=True)
    said = Posed(source.folder, classes=SET, up="y").assumptions()
    assert said[0].startswith(
        "2 of 4 rooms give no floor_m: the floor is estimated from the lowest"
    )
    assert said[1].startswith(
        "3 of 4 rooms give no metres_per_unit: poses are assumed to be in metres,"
    )
    assert said[2] == (
        "In 3 of 4 rooms the tops of the pictures point along z, but y is taken as up; should "
        "it be --up z?"
    )
    told = Posed(source.folder, classes=SET, floor_m=0.0, metres_per_unit=0.5)
    (lying,) = told.assumptions()
    assert lying.startswith("1 of 4 rooms do not state the up direction: it is estimated from the")
    assert "If they roll by 5 degrees, the median error is 1.3 degrees" in lying


def test_a_room_that_shows_nothing_is_filtered(source, rooms):
    for view in range(5):
        Image.fromarray(np.zeros((96, 128), dtype=np.uint8)).save(rooms[1].png(view))
    line = source.prepare(RoomTask("room_1", "room_1", "train"), None)
    assert (line.status, line.rule) == ("filtered", "no_view")
    assert line.reason == "none of its 5 views shows any object"


def test_the_command(rooms, tmp_path, cli):
    rooms[0].write()
    words = (
        "prep-posed", tmp_path / "rooms", "--out", tmp_path / "shards", "--label-set", SET,
        "--max-side", 64, "--workers", 1, "--test-share", 0.25,
    )  # fmt: skip
    made = cli(*words)
    assert made.exit_code == 0, made.output
    assert "Note: 1 of 4 rooms give no floor_m" in made.stderr
    assert "train 3 rooms, 15 views" in made.stdout
    assert json.loads((tmp_path / "shards/index.json").read_text())["label_set"] == SET
    looked = cli("inspect", tmp_path / "shards", "--room", "room_0")
    assert looked.exit_code == 0 and "unknown" in looked.stdout, looked.output
    checked = cli("inspect", tmp_path / "shards", "--verify")
    assert checked.exit_code == 0, checked.output
    said = next(line for line in made.stderr.splitlines() if "could not be checked" in line)
    verdict = said.removeprefix("Note: ")
    assert verdict.startswith("nothing wrong") and verdict in " ".join(checked.stdout.split())
    rooms[2].png(0).unlink()
    assert "was begun with other settings (rooms differ)" in str(cli(*words).exception)
