"""transforms.json: what is read of it, and one sentence for whatever it may hold instead."""

import numpy as np
import pytest
from posed_files import PosedRoom

from data_prep.readers.posed.recording import frame_intrinsics, room_name
from data_prep.readers.posed.transforms import read_recording
from sceneprior.core.errors import InputError


@pytest.fixture
def room(tmp_path):
    return PosedRoom(tmp_path / "room")


def refusal(folder):
    with pytest.raises(InputError) as error:
        recording = read_recording(folder)
        for frame in recording.frames:
            frame_intrinsics(frame, (96, 128))
    return str(error.value)


def test_frames_poses_and_their_files(room):
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


def test_room_names(tmp_path, monkeypatch):
    assert room_name(tmp_path / "a") == "a"
    monkeypatch.chdir(tmp_path)
    assert room_name(".") == tmp_path.name


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"frames": []}, "has no list `frames` with a frame in it."),
        ({"frames": [{"file_path": 3}]}, "frame 0: it has no `file_path`."),
        ({"frames": [{"file_path": "a"}]}, "frame 'a': `transform_matrix` is not a list of 4 rows"),
        ({"fl_x": "wide"}, "fl_x is 'wide'; input should be a valid number."),
        ({"w": 12.5}, "frame 'images/frame_00000.jpg': w, h are 12.5, 96.0; expected pixel counts"),
        ({"fl_x": None}, "has no fl_x and no camera_angle_x, here or for the whole file"),
        ({"fl_x": -1}, "fl_x, fl_y are -1.0, 80.0; expected above 0"),
        (
            {"fl_x": None, "camera_angle_x": 62.0},
            "camera_angle_x is 62, expected radians between 0 and pi; degrees? Give radians: 1.08",
        ),
        ({"fl_y": None, "camera_angle_y": 180}, "camera_angle_y is 180, expected radians between"),
        (
            {"fl_y": 2600},
            "fl_y: a focal length of 2600 pixels in an image of 128 x 96 sees 2.82 deg",
        ),
        ({"fl_x": 0.6}, "in an image of 128 x 96 sees 179 degrees, expected 5 to 160; give pixels"),
        ({"k4": 0.03}, "its k4 is 0.03, which OPENCV does not have."),
        ({"camera_model": "FULL_OPENCV"}, "its camera_model is FULL_OPENCV; expected a pinhole,"),
        ({"is_fisheye": True, "p2": 0.1}, "its p2 is 0.1, which OPENCV_FISHEYE does not have."),
        ({"metres_per_unit": 0}, "metres_per_unit is 0; input should be greater than 0."),
        ({"floor_center_m": [1]}, "floor_center_m.1 is [1]; field required."),
    ],
)
def test_a_wrong_key_is_a_sentence(room, changes, said):
    room.write(**changes)
    message = refusal(room.folder)
    assert said in message
    assert message.startswith(str(room.folder / "transforms.json")) or "frame 'images" in message


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"transform_matrix": [[1, 2], [3, 4]]}, "`transform_matrix` is not a list of 4 rows of 4"),
        ({"instance_path": 3}, "instance_path is 3; input should be a valid string."),
        ({"instance_path": "a\0b"}, "'a\\x00b' is not a valid file name."),
        ({"instance_path": "x" * 300}, "xxx...' is not a valid file name."),
        ({"file_path": "other/frame_00000.png"}, "would share the ids in "),
    ],
)
def test_a_wrong_frame_is_named(room, changes, said):
    room.write()
    data = room.data
    data["frames"][1] |= changes
    room.write_transforms(data)
    message = refusal(room.folder)
    assert said in message and data["frames"][1]["file_path"] in message


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", '{"frames": 3}', "[" * 100_000, "\udcff"])
def test_what_is_no_transforms_json(room, text):
    room.folder.mkdir()
    (room.folder / "transforms.json").write_bytes(text.encode("utf-8", "surrogateescape"))
    message = refusal(room.folder)
    sentences = "is not JSON", "expected a JSON object", "has no list `frames`"
    assert any(sentence in message for sentence in sentences)


def test_a_missing_file(tmp_path):
    assert "transforms.json cannot be read (No such file" in refusal(tmp_path)
