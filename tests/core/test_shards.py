"""The shard format: what is written is read, whole or not at all, and damage is one sentence."""

import errno
import fcntl
import os
from dataclasses import fields, replace

import h5py
import numpy as np
import pytest
from made_shards import make_room, make_truth, with_stuff
from toy_rooms import write_shard

from data_prep.readers.annotations import read_hdf5
from sceneprior.core.errors import InputError, ShardError
from sceneprior.core.observations import stuff_size, stuff_step, thinned, thinned_intrinsics
from sceneprior.core.shard_writing import room_checksum
from sceneprior.core.shards import Shard, iterate_rooms


def assert_same(one, other):
    for item in fields(one):
        left, right = getattr(one, item.name), getattr(other, item.name)
        if isinstance(left, np.ndarray):
            np.testing.assert_array_equal(left, right)
            assert left.dtype == right.dtype, item.name
        else:
            assert left == right, item.name


def test_round_trip(tmp_path):
    path = tmp_path / "train" / "a.h5"
    rooms = [(make_room("h/1", seed=1), make_truth(seed=1)), (make_room("h_2", 5, 3), None)]
    write_shard(path, "front3d_bedroom", rooms)
    with Shard(path) as shard:
        assert shard.label_set == "front3d_bedroom"
        assert sorted(shard.room_ids) == ["h/1", "h_2"]
        for views, _ in rooms:
            assert_same(views, shard.read_room(views.room_id, images=True))
            assert shard.read_room(views.room_id).instance_ids is None
        assert_same(rooms[0][1], shard.read_ground_truth("h/1"))
        with pytest.raises(ShardError, match="room h_2 carries no 3D ground truth"):
            shard.read_ground_truth("h_2")
    assert {room_id for _, room_id in iterate_rooms(tmp_path, "train")} == {"h/1", "h_2"}


@pytest.mark.parametrize("size", [(12, 16), (360, 480), (361, 479), (968, 1296), (324, 250)])
def test_thinned_pixels_are_where_their_intrinsics_say(size):
    step = stuff_step(size)
    rows, columns = (part[thinned(step)] for part in np.indices(size))
    assert rows.shape == stuff_size(size)
    assert step == 1 or 160 <= max(rows.shape) <= 320
    K = np.array([[100.0, 0, 7], [0, 90, 5], [0, 0, 1]])
    small = thinned_intrinsics(K, step)
    for row, column in ((0, 0), (rows.shape[0] - 1, 2)):
        pixel = np.array([columns[row, column] + 0.5, rows[row, column] + 0.5, 1])
        ray = np.linalg.solve(K, pixel)
        np.testing.assert_allclose(small @ ray, [column + 0.5, row + 0.5, 1], atol=1e-12)


@pytest.mark.parametrize(
    "stored",
    [
        {"chunks": (1, 60, 80), "compression": "gzip"},
        {"chunks": (1, 60, 80), "compression": "gzip", "shuffle": True},
        {"chunks": (2, 30, 80), "compression": "gzip"},
        {"chunks": (1, 60, 80), "compression": "lzf"},
        {"chunks": (1, 60, 80)},
        {},
    ],
)
def test_images_are_read_as_hdf5_reads_them_however_they_are_stored(tmp_path, stored):
    room = make_room(views=5, objects=254, size=(60, 80))
    write_shard(tmp_path / "a.h5", "front3d_bedroom", [(room, None)])
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        group = file["rooms/house_A"]
        noise = np.random.default_rng(0).integers(0, 255, (60, 80), dtype=room.instance_ids.dtype)
        ids = np.concatenate([group["instance_ids"][:-1], noise[None]])
        del group["instance_ids"]
        group.create_dataset("instance_ids", data=ids, **stored)
    with Shard(tmp_path / "a.h5") as shard:
        read = shard.read_instance_ids("house_A", [4, 1, -5])
        with pytest.raises((IndexError, ValueError)):
            shard.read_instance_ids("house_A", [5])
    np.testing.assert_array_equal(read, ids[[4, 1, 0]])


def test_shards_of_version_1_are_read_and_those_of_the_future_are_not(tmp_path):
    write_shard(tmp_path / "a.h5", "front3d_bedroom", [(make_room(), make_truth())])
    for version in (1, 3):
        with h5py.File(tmp_path / "a.h5", "r+") as file:
            assert file.attrs["version"] == (2 if version == 1 else 1)
            file.attrs["version"] = version
        if version == 1:
            with Shard(tmp_path / "a.h5") as shard:
                assert_same(shard.read_room("house_A", images=True), make_room())
    with pytest.raises(ShardError, match=r"version 3, expected .* Prepare the data again"):
        Shard(tmp_path / "a.h5")


def test_a_checksum_covers_everything_and_survives_the_file(tmp_path):
    room, truth = with_stuff(make_room()), make_truth()
    room = replace(room, turned_deg=12.5, room_from_world=np.eye(4))
    write_shard(tmp_path / "a.h5", "front3d_bedroom", [(room, truth), (make_room("bare"), None)])
    with Shard(tmp_path / "a.h5") as shard:
        assert shard.has_ground_truth("house_A") and not shard.has_ground_truth("bare")
        stored = shard.read_checksum("house_A")
        read = shard.read_room("house_A", images=True), shard.read_ground_truth("house_A")
        assert stored == room_checksum(*read) == room_checksum(room, truth)
        bare = shard.read_room("bare", images=True)
        assert shard.read_checksum("bare") == room_checksum(bare, None) != stored
    for of, pair in ((room, 0), (truth, 1)):
        for item in fields(of):
            value = getattr(of, item.name)
            if isinstance(value, np.ndarray):
                other = value.copy()
                other.flat[-1] = other.flat[-1] == 0
            else:
                other = {
                    "room_id": "b", "image_size": (16, 12), "height_m": 3.0, "turned_deg": 9.0,
                }.get(item.name, ("a", "b", "c"))  # fmt: skip
            both = [room, truth]
            both[pair] = replace(of, **{item.name: other})
            assert room_checksum(*both) != stored, item.name


def test_shards_of_before_have_no_checksum(tmp_path):
    write_shard(tmp_path / "a.h5", "front3d_bedroom", [(make_room(), None)])
    with h5py.File(tmp_path / "a.h5", "a") as file:
        del file["rooms/house_A"].attrs["sha256"]
    with Shard(tmp_path / "a.h5") as shard:
        assert shard.read_checksum("house_A") is None
        for read in (shard.read_checksum, shard.has_ground_truth):
            with pytest.raises(ShardError, match="room nowhere cannot be read"):
                read("nowhere")


def read_as_shard(path):
    with Shard(path) as shard:
        return shard.room_ids


def read_as_annotation(path):
    return read_hdf5(path, ["rooms/h_1/boxes"], "render it again")


READERS = {"shard": read_as_shard, "annotation": read_as_annotation}
NOT_DAMAGE = (
    errno.EAGAIN, errno.ENOLCK, errno.EACCES, errno.EMFILE, errno.ELOOP, errno.EIO, errno.ESTALE,
)  # fmt: skip


@pytest.fixture
def written(tmp_path):
    path = tmp_path / "train" / "a.h5"
    write_shard(path, "front3d_bedroom", [(make_room("h_1"), make_truth())])
    return path


@pytest.mark.parametrize("reads", READERS.values(), ids=READERS)
@pytest.mark.parametrize("number", NOT_DAMAGE)
def test_a_file_that_cannot_be_opened_is_not_called_damaged(written, monkeypatch, reads, number):
    def fails(*_, **__):
        raise OSError(number, f"Unable to open file (errno = {number})")

    monkeypatch.setattr(h5py, "File", fails)
    with pytest.raises(InputError, match=os.strerror(number)) as error:
        reads(written)
    assert "damaged" not in str(error.value) and "elete" not in str(error.value)


@pytest.mark.parametrize("reads", READERS.values(), ids=READERS)
def test_a_file_without_locks_is_read(written, monkeypatch, reads):
    opened = h5py.File

    def without_locks(*arguments, locking=None):
        if locking is not False:
            raise OSError(errno.ENOLCK, "no locks")
        return opened(*arguments, locking=locking)

    monkeypatch.setattr(h5py, "File", without_locks)
    assert reads(written)


def test_a_file_that_another_program_writes_is_not_called_damaged(written):
    with written.open("r+b") as other:
        fcntl.flock(other, fcntl.LOCK_EX)  # as h5py does
        assert read_as_shard(written)  # is whole, whoever holds it
        with pytest.raises(InputError, match="another program has it open for writing"):
            read_as_annotation(written)
        other.truncate(1000)
        for reads in READERS.values():
            with pytest.raises(InputError, match="another program") as error:
                reads(written)
            assert "damaged" not in str(error.value)
    for reads in READERS.values():
        with pytest.raises(InputError, match=r"truncated file.*damaged"):
            reads(written)
