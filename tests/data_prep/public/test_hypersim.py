"""Hypersim's damaged or foreign files."""

import csv
import shutil

import h5py
import numpy as np
import pytest
from public_files import cam_from_uv, furnished, write_hdf5, write_hypersim

from data_prep.engine.source import RoomTask
from data_prep.readers.source import PublicSource, open_reader
from sceneprior.core.errors import InputError

SCENE = "ai_001_001"
CSV = "metadata_camera_parameters.csv"


@pytest.fixture
def scenes(tmp_path):
    folder = tmp_path / "scenes"
    write_hypersim(folder, SCENE, furnished(tmp_path), cam_from_uv(furnished(tmp_path)))
    return folder


def read(folder):
    source = PublicSource(open_reader("hypersim", folder))
    source.settings(None)
    return source.prepare(RoomTask(SCENE, SCENE, "train"), None)


def change_row(folder, **changes):
    rows = list(csv.DictReader((folder / CSV).open()))
    with (folder / CSV).open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows([{**rows[0], **changes}])


def truncate(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


DAMAGE = {
    "no table of cameras": (
        lambda f: (f / CSV).unlink(), r"is missing: the projection of each scene. Copy it from",
    ),
    "a foreign table": (
        lambda f: (f / CSV).write_text("a,b\n1,2\n"), r"has no columns scene_name and M_cam_from",
    ),
    "a binary table": (
        lambda f: (f / CSV).write_bytes(b"\xff\xfe\x00"), r"cannot be read \(.*; download the",
    ),
    "no row": (lambda f: change_row(f, scene_name="ai_9"), r"has no row for ai_001_001"),
    "no size": (
        lambda f: change_row(f, settings_output_img_width="wide"),
        r"has no numbers in settings_output_img_height to settings_output_img_width",
    ),
    "no projection": (
        lambda f: change_row(f, M_cam_from_uv_22="1"), r"M_cam_from_uv is no projection",
    ),
    "no unit": (
        lambda f: (f / SCENE / "_detail/metadata_scene.csv").write_text("a,b\n"),
        r"meters_per_asset_unit, has no numbers in parameter_value",
    ),
    "a negative unit": (
        lambda f: (f / SCENE / "_detail/metadata_scene.csv").write_text(
            "parameter_name,parameter_value\nmeters_per_asset_unit,-1\n"
        ),
        r"meters_per_asset_unit is -1",
    ),
    "a truncated trajectory": (
        lambda f: truncate(f / SCENE / "_detail/cam_00/camera_keyframe_positions.hdf5"),
        r"positions.hdf5 cannot be read \(.*\): it is damaged; download the scene again",
    ),
    "poses of other frames": (
        lambda f: write_hdf5(
            f / SCENE / "_detail/cam_00/camera_keyframe_positions.hdf5", dataset=np.zeros((3, 3))
        ),
        r"positions have the shape \(3, 3\) and orientations \(2, 3, 3\)",
    ),
    "an image of depth": (
        lambda f: write_hdf5(
            f / SCENE / "images/scene_cam_00_geometry_hdf5/frame.0001.semantic_instance.hdf5",
            dataset=np.zeros((96, 128)),
        ),
        r"holds float64 of the shape \(96, 128\), expected integers of \(96, 128\)",
    ),
    "an array of another name": (
        lambda f: write_hdf5(
            f / SCENE / "images/scene_cam_00_geometry_hdf5/frame.0001.semantic.hdf5", data=np.eye(2)
        ),
        r"has no 'dataset' \(it has data\); download the scene again",
    ),
    "no boxes": (
        lambda f: next((f / SCENE / "_detail/mesh").glob("*extents*")).unlink(),
        r"extents.hdf5 is missing; download",
    ),
    "boxes of another scene": (
        lambda f: write_hdf5(
            next((f / SCENE / "_detail/mesh").glob("*extents*")), dataset=np.zeros((2, 3))
        ),
        r"its arrays of 3D boxes do not belong together",
    ),
}  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_files_are_named_in_one_sentence(scenes, damage):
    change, message = DAMAGE[damage]
    change(scenes)
    with pytest.raises(InputError, match=message):
        read(scenes)


def test_a_scene_without_images_or_trajectories_is_refused(scenes):
    shutil.rmtree(scenes / SCENE / "images")
    with pytest.raises(
        InputError, match=r"has no usable frame: 0 of 5 have no usable pose, 5 no im"
    ):
        read(scenes)
    for name in ("cam_00", "cam_01"):
        shutil.rmtree(scenes / SCENE / "_detail" / name)
    with pytest.raises(InputError, match=r"ai_001_001 has no trajectory in _detail/cam_XX"):
        read(scenes)


def test_cameras_below_the_floor_are_refused(scenes):
    path = scenes / SCENE / "_detail/cam_00/camera_keyframe_positions.hdf5"
    write_hdf5(path, dataset=np.full((2, 3), -100.0))
    with pytest.raises(
        InputError, match=r"its lowest camera is at -2.54 m, below the floor at 0.00"
    ):
        read(scenes)


def test_objects_without_a_box_leave_a_room_without_ground_truth(scenes):
    path = next((scenes / SCENE / "_detail/mesh").glob("*positions*"))
    with h5py.File(path, "r+") as file:
        file["dataset"][300] = np.nan
    made = read(scenes)
    assert made.truth is None and made.notes[-1] == "1 of 2 objects have no 3D box: no ground truth"
    with h5py.File(path, "r+") as file:
        file["dataset"][:] = np.nan
    with pytest.raises(
        InputError, match=r"no visible object has a 3D box, so the floor is unknown"
    ):
        read(scenes)


def test_a_room_of_walls_alone_shows_no_object(tmp_path):
    room = furnished(tmp_path)
    room.things = room.things[2:]
    write_hypersim(tmp_path / "scenes", SCENE, room, cam_from_uv(room))
    line = read(tmp_path / "scenes")
    assert line.rule == "no_view" and line.reason == "none of its 4 views shows any object"
