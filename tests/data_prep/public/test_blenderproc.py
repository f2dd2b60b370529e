"""BlenderProc's frames that other scripts wrote, damaged ones, and rooms of other types."""

import json

import h5py
import numpy as np
import pytest
from public_files import furnished, write_blenderproc, write_hdf5

from data_prep.engine.workers import pool
from data_prep.readers.source import PublicSource, open_reader
from sceneprior.core.errors import InputError


@pytest.fixture
def renders(tmp_path):
    write_blenderproc(tmp_path / "renders", "house", furnished(tmp_path))
    return tmp_path / "renders"


def read(folder, recipe="bedroom"):
    source = PublicSource(open_reader("blenderproc", folder, recipe))
    source.settings(None)
    with pool(1) as run:
        (task,) = source.survey(run).rooms
    return source.prepare(task, None)


def rewrite(path, **changes):
    with h5py.File(path) as file:
        arrays = {name: file[name][()] for name in file}
    arrays |= changes
    write_hdf5(path, **{name: array for name, array in arrays.items() if array is not None})


def test_frames_without_cameras_say_what_to_render(tmp_path):
    write_blenderproc(tmp_path / "renders", "house", furnished(tmp_path), cameras=False)
    with pytest.raises(
        InputError, match=r"0.hdf5 has no 'cam_Ts' .* render it again with a script"
    ):
        read(tmp_path / "renders")


def test_prefixed_attributes_and_numbers_of_rooms_are_read(renders):
    with h5py.File(renders / "house/0.hdf5") as file:
        parts = json.loads(bytes(file["instance_attribute_maps"][()]))
    old = [{key if key == "idx" else f"cp_{key}": x for key, x in part.items()} for part in parts]
    for part in old:
        part["cp_room_id"] = 7
    text = np.bytes_(json.dumps(old))
    for view in range(5):
        rewrite(renders / "house" / f"{view}.hdf5", instance_attribute_maps=text)
    made = read(renders, "all")
    assert made.views.room_id == "house_7" and len(made.views.visible) == 5


def test_rooms_of_other_types_are_left_out(renders):
    assert read(renders, "kitchen").views.room_id == "house_Kitchen-2"
    with pytest.raises(InputError, match=r"No room of .*renders can be prepared"):
        read(renders, "library")


JUNK = np.bytes_("[{}]")
DAMAGE = {
    "no camera matrix": (
        lambda f: (f / "cam_K.npy").unlink(), r"cam_K.npy cannot be read .* beside the houses",
    ),
    "a truncated camera matrix": (
        lambda f: (f / "cam_K.npy").write_bytes(b"\x93NUMPY"), r"cam_K.npy cannot be read",
    ),
    "another matrix": (
        lambda f: np.save(f / "cam_K.npy", np.eye(4)), r"cam_K.npy holds no camera matrix of 3 x 3",
    ),
    "no table of classes": (
        lambda f: (f / "model_info.json").unlink(),
        r"has neither 3D-FUTURE's model_info.json nor BlenderProc's blender_label_mapping.csv",
    ),
}  # fmt: skip
FRAME = {
    "a picture alone": (
        {"instance_segmaps": None}, r"has no 'instance_segmaps' \(it has cam_Ts, class_segmaps",
    ),
    "ids of three channels": (
        {"instance_segmaps": np.zeros((4, 4, 3), int)}, r"instance_segmaps is no image of ids",
    ),
    "no attributes": ({"instance_attribute_maps": JUNK}, r"is not a list with idx, inst_mark and"),
    "no JSON": ({"instance_attribute_maps": np.bytes_("[")}, r"is not a list with idx, inst_mark"),
    "no marks": (
        {"instance_attribute_maps": np.bytes_('[{"idx": 1, "room_id": 0}]')},
        r"is not a list with idx, inst_mark",
    ),
    "half a pose": ({"cam_Ts": np.eye(3)}, r"cam_Ts is \(3, 3\), not a 4 x 4 matrix"),
    "a lost pose": ({"cam_Ts": np.full((4, 4), np.nan)}, r"4 have no usable pose"),
    "a huge array": (
        {"instance_segmaps": h5py.Empty("u1")}, r"'instance_segmaps' has None values",
    ),
}  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_folders_are_named_in_one_sentence(renders, damage):
    change, message = DAMAGE[damage]
    change(renders)
    with pytest.raises(InputError, match=message):
        read(renders)


@pytest.mark.parametrize("damage", FRAME)
def test_damaged_frames_are_named_in_one_sentence(renders, damage):
    changes, message = FRAME[damage]
    for view in range(5):
        rewrite(renders / "house" / f"{view}.hdf5", **changes)
    with pytest.raises(InputError, match=message):
        read(renders)


def test_a_truncated_frame_fails_its_house_by_name(renders, tmp_path, cli):
    path = renders / "house" / "1.hdf5"
    path.write_bytes(path.read_bytes()[:900])
    write_blenderproc(renders, "other", furnished(tmp_path))
    out = tmp_path / "shards"
    made = cli("prep-dataset", "blenderproc", renders, "--out", out, "--workers", 1)
    report = json.loads((out / "report.json").read_text())
    assert report["statuses"]["prepared"] == 1
    (failed,) = report["failed"]
    assert failed["room_id"] == "house" and "1.hdf5 cannot be read" in failed["reason"]
    assert made.exit_code == 3


def test_frames_of_two_sizes_are_refused(renders):
    rewrite(renders / "house" / "3.hdf5", instance_segmaps=np.zeros((50, 60), np.uint8))
    with pytest.raises(InputError, match=r"3.hdf5 is 60 x 50 pixels, but the frames before it"):
        read(renders)


def test_a_foreign_table_of_classes_is_refused(renders):
    (renders / "model_info.json").unlink()
    (renders / "blender_label_mapping.csv").write_text("id;name\n1;bed\n")
    with pytest.raises(InputError, match=r"is not BlenderProc's table of the columns id and name"):
        read(renders)
