"""Posed rooms to views: every box where the picture says, whatever the axes, units and sizes."""

import json

import numpy as np
import pytest
from PIL import Image
from posed_files import SET, PosedRoom, furniture, in_room, overlaps, prepared

from data_prep.inspection.checks import array_problems, mask_problems
from data_prep.readers.posed.cameras import cameras_in_room, seems_up, upright_cameras
from data_prep.readers.posed.transforms import read_recording
from data_prep.readers.posed.views import PosedSettings
from sceneprior.core.boxes import quarter_rotation, yaw_rotation
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError


@pytest.fixture
def room(tmp_path):
    return PosedRoom(tmp_path / "room")


def check(views):
    assert not [*array_problems(views, len(label_set(SET))), *mask_problems(views)]


def test_things_are_where_their_masks_are(room):
    room.write(floor_m=0.0, floor_center_m=[0.1, -0.2])
    made = prepared(room)
    views = made.views
    check(views)
    assert views.object_class.tolist() == [1, 2] and made.truth is None
    assert views.room_id == "room" and views.image_size == (96, 128)
    assert made.notes == ("classes outside the label set are void: backpack (1)",)
    iou = overlaps(views, in_room(room))
    assert len(iou) >= 2 and iou.min() > 0.95  # some 30 pixels wide, half a pixel a side


@pytest.mark.parametrize("up", ["y", "z"])
def test_units_and_axes_are_those_of_the_settings(room, up):
    """The same room in feet, or with y up, is the same room."""
    room.write(floor_m=0.0, floor_center_m=[0.1, -0.2])
    plain = prepared(room).views
    data, feet = room.data, 1 / 0.3048
    for frame, pose in zip(data["frames"], room.poses, strict=True):
        pose = pose.copy()
        pose[:3, 3] *= feet
        if up == "y":
            pose = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]) @ pose
        frame["transform_matrix"] = pose[:3].tolist()  # a last row may be left out
    center = [0.1, -0.2] if up == "z" else [0.1, 0.2]
    room.write_transforms(data | {"floor_m": 0.0, "floor_center_m": center})
    turned = prepared(room, up=up, metres_per_unit=0.3048).views
    np.testing.assert_allclose(turned.world_to_camera, plain.world_to_camera, atol=1e-6)
    room.write_transforms(
        data | {"floor_m": 0, "floor_center_m": center, "metres_per_unit": 0.3048}
    )
    same = prepared(room, up=up, metres_per_unit=9.0).views  # the file wins
    np.testing.assert_array_equal(same.world_to_camera, turned.world_to_camera)
    assert seems_up(read_recording(room.folder)) == up


def test_an_unknown_floor_is_an_assumption_that_is_said(room):
    room.poses = room.poses[:2]  # too few to find it: test_floor.py
    room.write()
    made = prepared(room, camera_height_m=1.3)
    why = "too few pieces show where they end"
    assert made.notes[-1] == f"the floor is assumed 1.3 m below the lowest camera ({why})"
    eyes = np.linalg.inv(made.views.world_to_camera.astype(float))[:, :3, 3]
    np.testing.assert_allclose(eyes[:, 1].min(), 1.3, atol=1e-5)  # float32 poses of metres
    middle = (eyes.min(axis=0) + eyes.max(axis=0))[[0, 2]] / 2
    np.testing.assert_allclose(middle, 0, atol=1e-5)
    told = prepared(room, floor_m=-0.1)
    eyes = np.linalg.inv(told.views.world_to_camera.astype(float))[:, :3, 3]
    np.testing.assert_allclose(eyes[:, 1].min(), 1.6, atol=1e-5)
    assert not any("assumed" in note for note in told.notes)


def test_smaller_masks_keep_their_lens(room):
    """Sampled down to any size, things stay where they are; so do masks smaller than pictures."""
    room.size, room.focal_px = (480, 640), 400.0
    room.write(floor_m=0.0, floor_center_m=[0.1, -0.2])
    for max_side, size in ((None, (480, 640)), (160, (120, 160)), (150, (112, 150))):
        views = prepared(room, max_side=max_side).views
        assert views.image_size == size
        check(views)
        assert overlaps(views, in_room(room)).mean() > 0.95
    small = PosedRoom(room.folder, size=(120, 160), focal_px=100.0)
    for view in range(5):
        Image.fromarray(small.ids(view)).save(room.png(view))
    views = prepared(room).views
    np.testing.assert_allclose(views.intrinsics[0, 0], [100, 0, 80], atol=1e-4)
    assert overlaps(views, in_room(room)).mean() > 0.95


def test_a_focal_length_may_be_an_angle_and_a_frames_own(room):
    angle = 2 * np.arctan(64 / 80)
    gone = dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "w", "h"))
    room.write(camera_angle_x=float(angle), **gone)
    views = prepared(room).views
    np.testing.assert_allclose(
        views.intrinsics[0], [[80, 0, 64], [0, 80, 48], [0, 0, 1]], atol=1e-4
    )
    data = room.data
    data["frames"][2]["fl_x"] = 77.0
    room.write_transforms(data)
    assert prepared(room).views.intrinsics[:, 0, 0].tolist() == [80, 80, 77, 80, 80]


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


def test_what_hides_and_what_does_not(room):
    """Void things and unknown pixels take away the clearness of a side; walls do not."""
    room.things = room.things[:1]
    room.write()
    (folder := room.folder / "known").mkdir()
    base = room.ids(0)
    rows, columns = np.nonzero(base)
    left = (slice(rows.min(), rows.max() + 1), slice(columns.min() - 9, columns.min()))
    assert prepared(room).views.sides_clear[0, 0].all()
    beside = base.copy()
    beside[left] = 9
    Image.fromarray(beside).save(room.png(0))
    unlisted = prepared(room)
    assert unlisted.views.sides_clear[0, 0].tolist() == [False, True, True, True]
    assert "the table of classes does not have (9): void" in " ".join(unlisted.notes)
    np.testing.assert_array_equal(unlisted.views.instance_ids[0] == 2, beside == 9)
    (room.folder / "classes.json").write_text('{"3": "bed", "9": "backpack"}')
    assert not prepared(room).views.sides_clear[0, 0].all()
    (room.folder / "classes.json").write_text('{"3": "bed", "9": "Wall"}')
    assert prepared(room).views.sides_clear[0, 0].all()
    assert prepared(room).views.instance_ids.max() == 1
    Image.fromarray(base).save(room.png(0))
    known = np.full(room.size, 255, dtype=np.uint8)
    known[left] = 0
    Image.fromarray(known).save(folder / "0.png")
    data = room.data
    data["frames"][0]["mask_path"] = "known/0.png"
    room.write_transforms(data)
    masked = prepared(room).views
    assert masked.sides_clear[0, 0].tolist() == [False, True, True, True]
    np.testing.assert_array_equal(masked.instance_ids[0] == 2, known == 0)
    check(masked)
    Image.fromarray(known[:-1]).save(folder / "0.png")
    with pytest.raises(InputError, match=r"known/0.png is 128 x 95 pixels, but the ids 128 x 96\."):
        prepared(room)


def test_nothing_of_the_label_set(room):
    room.things = furniture()[1:]
    for thing in room.things:
        thing.low, thing.high = (0, 0, 40), (1, 1, 41)
    room.write()
    assert prepared(room) is None
    (room.folder / "classes.json").write_text(json.dumps({"1": "lamp", "2": "vase"}))
    with pytest.raises(
        InputError, match=r"none of its classes .lamp, vase. is in the label set .bed, chair.\."
    ):
        prepared(room)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"floor_m": 1.55}, r"lowest camera is at 1\.50 m, below the floor at 1\.55 m: are the"),
        ({"metres_per_unit": 100}, r"cameras are spread over 480 m; is metres_per_unit wrong\?"),
        ({"w": 100}, r"masks are 128 x 96 pixels but the colour frames 100 x 96: with different"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(room, changes, said):
    room.write(**changes)
    with pytest.raises(InputError, match=said):
        prepared(room)


def test_no_usable_frame(room):
    room.poses = [np.diag([2.0, 2, 2, 1])] * 2
    room.write()
    with pytest.raises(InputError, match=r"no usable frame: 2 of 2 have no usable pose"):
        prepared(room)
    for view in range(2):
        room.png(view).unlink()
    with pytest.raises(InputError, match=r"of its 2 frames has a mask; expected /.*_00000\.png\."):
        prepared(room)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (
            lambda pose: pose @ np.diag([1.0, 1, -1, 1]),
            "it is left-handed, as of Unity or Unreal, or mirrored: negate one row of all matrices "
            "to make their world right-handed.",
        ),
        (lambda pose: pose * np.nan, "it holds NaN or infinity."),
        (lambda pose: pose.T, "it is transposed: its translation is in the last row."),
        (lambda pose: pose @ np.diag([3.0, 3, 3, 1]), "its axes have the length 3, expected 1."),
        (lambda pose: pose + np.eye(4)[::-1], "its last row is not 0, 0, 0, 1."),
        (lambda pose: pose @ np.diag([1.0, 2, 0.5, 1]), "its axes are no rotation."),
    ],
)
def test_poses_that_are_none_are_named_with_their_fault(room, wrong, said):
    room.poses = [wrong(pose) for pose in room.poses]
    room.write()
    with pytest.raises(InputError) as error:
        prepared(room)
    assert str(error.value).endswith(f"; frame 'images/frame_00000.jpg': {said}")


def test_all_frames_of_a_room_have_one_size(room):
    room.write()
    Image.fromarray(room.ids(1)[:, :-1]).save(room.png(1))
    with pytest.raises(
        InputError, match=r"127 x 96 pixels, but the first frame's 128 x 96; a room"
    ):
        prepared(room)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"up": "x"}, "up is 'x'; choose from auto, z, y, cameras."),
        ({"max_side": 0}, "max_side is 0; expected at least 1."),
        ({"camera_height_m": 0.0}, "camera_height_m is 0.0; it must be above 0."),
        ({"metres_per_unit": float("inf")}, "metres_per_unit is inf; it must be above 0."),
        ({"floor_m": float("nan")}, "floor_m is nan; expected a height in metres."),
    ],
)
def test_settings_are_checked(settings, said):
    with pytest.raises(InputError) as error:
        PosedSettings(**settings)
    assert str(error.value) == said


def test_the_axis_that_seems_up(room):
    room.poses = [np.eye(4)]  # looks along -z, top along y
    room.write()
    recording = read_recording(room.folder)
    assert seems_up(recording) == "y"
    upright, turn = upright_cameras(recording, [0], "y", 1.0)
    assert cameras_in_room(recording, upright, turn, -1.0).shape == (1, 4, 4)
    room.poses = [np.full((4, 4), np.nan)]
    room.write()
    assert seems_up(read_recording(room.folder)) is None


@pytest.mark.parametrize("degrees", [33.0, -57.0, 123.0])
@pytest.mark.parametrize("keys", [{}, {"floor_m": 0.0, "floor_center_m": (0.1, -0.2)}])
def test_a_capture_with_any_heading_is_the_same_room(room, degrees, keys):
    """The world of the poses is turned about its z axis: the room is the same, up to quarters."""
    for eye in [(-2.5, 0.1, 1.5), (2.5, 0.3, 1.6), (0.1, 2.6, 1.4), (1.6, -2.4, 1.7)]:
        room.look(eye, (0.1, 0.1, 0.3))
    room.size, room.focal_px = (192, 256), 160.0
    plain = prepared(room.write(**keys))
    assert plain.views.turned_deg == 0 and plain.views.room_from_world is None
    assert not any("turned" in note for note in plain.notes)
    exact = np.array(plain.cameras["room_from_world"])[:3, :3]
    assert np.isin(exact, (0, 1, -1)).all()  # not even by last bits
    turn = np.eye(4)
    turn[:2, :2] = yaw_rotation(np.radians(degrees))[::2, ::2]
    room.poses = [turn @ pose for pose in room.poses]
    if "floor_center_m" in keys:
        center = turn[:2, :2] @ keys["floor_center_m"]
        keys = keys | {"floor_center_m": center.tolist()}
    room.write_transforms(room.data | keys)  # the masks are those of before
    made = prepared(room)
    views = made.views
    assert -45 <= views.turned_deg <= 45 and abs(views.turned_deg) > 1
    assert f"turned by {views.turned_deg:.2f} degrees, along its walls" in " ".join(made.notes)
    np.testing.assert_array_equal(views.instance_ids, plain.views.instance_ids)
    np.testing.assert_allclose(views.room_from_world, made.cameras["room_from_world"], atol=1e-8)
    # The file's poses, mapped by the shard's matrix, are the room's cameras.
    mapped = views.room_from_world @ np.array(room.poses) @ np.diag([1.0, -1, -1, 1])
    here = np.linalg.inv(views.world_to_camera.astype(float))
    np.testing.assert_allclose(mapped, here, atol=1e-5)
    quarters = [quarter_rotation(k) for k in range(4)]
    there = np.linalg.inv(plain.views.world_to_camera.astype(float))[:, :3, 3]
    apart = [np.abs(here[:, :3, 3] - there @ quarter.T).max() for quarter in quarters]
    # 0.3 degrees at 3 m; and the middle of the cameras' bounding box moves a little, too.
    assert min(apart) < 0.03
