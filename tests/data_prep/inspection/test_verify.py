"""A folder held against itself: what is damaged, swapped or missing is found and named."""

import shutil

import h5py
import numpy as np
import pytest
from front_jobs import change_room, six_bedrooms_shards

from data_prep.inspection.verify import verify
from sceneprior.core.errors import InputError

RULES = ("views.per_m2=1.5", "views.image_size=[120, 160]")


@pytest.fixture
def shards(made_once, tmp_path):
    made = made_once("verified", lambda folder: six_bedrooms_shards(folder, *RULES))
    return shutil.copytree(made, tmp_path / "shards")


def test_several_workers_find_the_same(shards):
    found = verify(shards)
    assert found.problems == () and verify(shards, workers=2) == found


def test_one_room(shards):
    verdict = verify(shards, "house1_MasterBedroom-1")
    assert [room.room_id for rooms in verdict.rooms.values() for room in rooms] == [
        "house1_MasterBedroom-1"
    ]


def test_a_folder_without_rooms(shards):
    for split in ("train", "val", "test"):
        shutil.rmtree(shards / split)
    with pytest.raises(InputError, match="holds no rooms; prepare them again"):
        verify(shards)


def test_a_changed_number_breaks_the_checksum(shards):
    path = next((shards / "train").glob("*.h5"))
    room_id = change_room(
        path, lambda group: group["ground_truth/yaw_rad"].write_direct(np.ones(3, "f4")), seal=False
    )
    assert verify(shards).problems == (
        f"{path}, room {room_id}: its checksum does not match its contents: the file was changed "
        "or damaged.",
    )


def test_a_box_that_does_not_fit_is_found_under_a_right_checksum(shards):
    path = next((shards / "train").glob("*.h5"))

    def shift(group):
        boxes = group["boxes"][()]
        boxes[group["visible"][()], 0] *= 0.5
        group["boxes"][...] = boxes

    room_id = change_room(path, shift)
    problem = verify(shards).problems[0]
    assert "checksum" not in problem and problem.startswith(f"{path}, room {room_id}: view ")
    assert problem.endswith("its 2D box does not fit its mask.")


def test_a_truncated_shard_a_missing_one_and_another_label_set(shards):
    path = next((shards / "test").glob("*.h5"))
    whole = path.read_bytes()
    path.write_bytes(whole[:3000])
    (problem,) = verify(shards).problems
    assert problem.startswith(f"{path} cannot be read") and "the file is damaged" in problem
    assert problem.count(str(path)) == 1
    path.unlink()
    first, *_ = verify(shards).problems
    assert first == (
        f"{shards}: index.json counts 1 rooms in 'test', but its shards hold 0; run the same prep "
        "command again."
    )
    path.write_bytes(whole)
    with h5py.File(path, "a") as file:
        file.attrs["label_set"] = "scannet"
    assert (
        f"{path}: the shard is labelled 'scannet', index.json says 'front3d_bedroom'."
        in verify(shards).problems
    )


def test_arrays_of_wrong_shapes(shards):
    path = next((shards / "test").glob("*.h5"))

    def cut(group):
        sides = group["sides_clear"][()]
        del group["sides_clear"]
        group["sides_clear"] = sides[:1]

    change_room(path, cut, seal=False)
    assert "sides_clear has shape (1, 3, 4), expected" in verify(shards).problems[0]
