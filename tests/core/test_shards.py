"""The shard format: what is written is read, whole or not at all, and damage is one sentence."""

from dataclasses import fields, replace

import h5py
import numpy as np
import pytest
from toy_rooms import write_shard

from sceneprior.core.classes import STUFF
from sceneprior.core.errors import ShardError
from sceneprior.core.shard_writing import check_views, room_checksum
from sceneprior.core.shards import (
    RoomGroundTruth,
    RoomViews,
    Shard,
    iterate_rooms,
    list_shards,
    read_index,
    stuff_size,
    stuff_step,
    thinned,
    thinned_intrinsics,
)


def make_room(room_id="house_A", views=3, objects=2, size=(12, 16), seed=0):
    rng = np.random.default_rng(seed)
    visible = rng.random((views, objects)) < 0.7
    return RoomViews(
        room_id=room_id,
        object_class=rng.integers(1, 22, objects).astype(np.int16),
        world_to_camera=rng.normal(size=(views, 4, 4)).astype(np.float32),
        intrinsics=rng.normal(size=(views, 3, 3)).astype(np.float32),
        boxes=rng.random((views, objects, 4)).astype(np.float32) * visible[..., None],
        visible=visible,
        mask_pixels=(rng.integers(25, 99, (views, objects)) * visible).astype(np.int32),
        sides_clear=rng.random((views, objects, 4)) < 0.5,
        instance_ids=rng.integers(0, objects + 1, (views, *size)).astype(np.uint8),
        image_size=size,
    )


def with_stuff(room, seed=0):
    shape = (len(room.visible), *stuff_size(room.image_size))
    stuff = np.random.default_rng(seed).integers(0, len(STUFF), shape).astype(np.uint8)
    return replace(room, stuff=stuff)


def make_truth(objects=3, seed=0):
    rng = np.random.default_rng(seed)
    return RoomGroundTruth(
        object_class=rng.integers(1, 22, objects).astype(np.int16),
        centers_m=rng.normal(size=(objects, 3)).astype(np.float32),
        sizes_m=rng.random((objects, 3)).astype(np.float32),
        yaw_rad=rng.normal(size=objects).astype(np.float32),
        model_ids=tuple(f"model-{k}" for k in range(objects)),
        model_to_room=rng.normal(size=(objects, 4, 4)).astype(np.float32),
        floor_m=rng.normal(size=(6, 2)).astype(np.float32),
        height_m=2.7,
        unoccluded=rng.random((3, 2)) < 0.5,  # of the views and objects that make_room has
    )


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


def test_stuff_is_optional_and_read_with_the_images(tmp_path):
    rooms = [make_room("a"), with_stuff(make_room("b", 5, 3, (600, 900)))]
    assert rooms[1].stuff.shape == (5, 150, 225)
    write_shard(tmp_path / "a.h5", "front3d_bedroom", [(room, None) for room in rooms])
    with Shard(tmp_path / "a.h5") as shard:
        assert [shard.has_stuff(name) for name in "ab"] == [False, True]
        for room in rooms:
            read = shard.read_room(room.room_id, images=True)
            assert_same(read, room)
            assert shard.read_room(room.room_id).stuff is None
            assert shard.read_checksum(room.room_id) == room_checksum(read, None)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.full((3, 12, 16), 6, np.uint8), "stuff is 6, expected below 6"),
        (np.zeros((3, 6, 16), np.uint8), r"stuff has shape \(3, 6, 16\), expected \(3, 12, 16\)"),
        (np.zeros((3, 12, 16), np.float32), "stuff is float32"),
    ],
)
def test_damaged_stuff_is_one_sentence(tmp_path, value, message):
    write_shard(tmp_path / "a.h5", "front3d_bedroom", [(with_stuff(make_room()), None)])
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        del file["rooms/house_A/stuff"]
        file["rooms/house_A"].create_dataset("stuff", data=value)
    with Shard(tmp_path / "a.h5") as shard, pytest.raises(ShardError, match=message):
        shard.read_room("house_A", images=True)


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


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("boxes", np.zeros((3, 1, 4), np.float32), r"house_A: boxes has shape \(3, 1, 4\), expect"),
        ("instance_ids", np.zeros((2, 12, 16), np.uint8), "instance_ids has shape"),
        (
            "instance_ids",
            np.full((3, 12, 16), 4, np.uint8),
            r"instance id is 4, but the room has 2 objects, and 3 is void\.",
        ),
        ("instance_ids", None, "instance_ids has shape None"),
        ("stuff", np.zeros((3, 6, 8), np.uint8), r"stuff has shape \(3, 6, 8\), expected \(3, 12"),
    ],
)
def test_rooms_that_disagree_with_themselves_are_refused(name, value, message):
    with pytest.raises(ShardError, match=message):
        check_views("a.h5", replace(make_room(), **{name: value}))


def test_a_failure_midway_leaves_nothing(tmp_path, monkeypatch):
    def full_disk(*_):
        raise OSError("No space left on device")

    monkeypatch.setattr("sceneprior.core.shard_writing._write_room", full_disk)
    with pytest.raises(OSError, match="No space"):
        write_shard(tmp_path / "a.h5", "front3d_bedroom", [(make_room(), None)])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("keep", [0, 100, 0.5, 0.9])
def test_truncated_shards_are_one_sentence(tmp_path, keep):
    path = tmp_path / "a.h5"
    write_shard(path, "front3d_bedroom", [(make_room(size=(120, 160)), make_truth())])
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data)) if keep < 1 else keep])
    with pytest.raises(ShardError, match=r"the file is damaged\. Delete it and run the same"):
        Shard(path)


def test_damaged_pixels_name_the_room(tmp_path):
    path = tmp_path / "a.h5"
    write_shard(path, "front3d_bedroom", [(make_room(size=(120, 160)), make_truth())])
    with h5py.File(path) as file:
        chunk = file["rooms/house_A/instance_ids"].id.get_chunk_info(1)
    data = bytearray(path.read_bytes())
    data[chunk.byte_offset : chunk.byte_offset + chunk.size] = bytes(chunk.size)
    path.write_bytes(data)
    with Shard(path) as shard:
        shard.read_room("house_A")
        shard.read_instance_ids("house_A", [0])
        with pytest.raises(ShardError, match=r"a\.h5, room house_A cannot be read"):
            shard.read_instance_ids("house_A", [1])


def test_other_formats_and_missing_files(tmp_path):
    with pytest.raises(ShardError, match="No shard at"):
        Shard(tmp_path / "none.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file.attrs["format"] = "something"
    with pytest.raises(
        ShardError, match=r"says format 'something' version None, expected .* 1 or 2"
    ):
        Shard(tmp_path / "other.h5")
    write_shard(tmp_path / "a.h5", "front3d_bedroom", [(make_room(), None)])
    with Shard(tmp_path / "a.h5") as shard, pytest.raises(ShardError, match="room house_Z"):
        shard.read_room("house_Z")


def test_folders(tmp_path):
    with pytest.raises(ShardError, match="No folder of shards at"):
        list_shards(tmp_path / "none", "train")
    for read in (read_index, lambda folder: list_shards(folder, "test")):
        with pytest.raises(ShardError, match=r"has no index\.json; it is not a finished folder"):
            read(tmp_path)
    (tmp_path / "index.json").write_text("{}")
    with pytest.raises(ShardError, match=r"The 'test' split of .* holds no shards"):
        list_shards(tmp_path, "test")
    (tmp_path / "index.json").write_text('{"a"')
    with pytest.raises(ShardError, match="is not JSON"):
        read_index(tmp_path)


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


def _replace(name, **made):
    def change(room):
        group, _, array = name.rpartition("/")
        parent = room[group] if group else room
        del parent[array]
        if made:
            parent.create_dataset(array, **made)

    return change


def _set(name, value, group=""):
    def change(room):
        (room[group] if group else room).attrs[name] = value

    return change


def _put(name, value):
    def change(room):
        room[name][0] = value

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_replace("boxes", data=np.zeros((3, 1, 4), "f4")), "boxes has shape (3, 1, 4), expected"),
        (_replace("boxes", data=np.zeros((3, 2, 4))), "boxes holds float64, expected float32"),
        (
            _replace("instance_ids", shape=(3, 2**20, 2**21), dtype="u1", chunks=(1, 9, 9)),
            "instance_ids claims 6597069766656 bytes, more than are stored",
        ),
        (_replace("instance_ids", data=np.zeros((3, 12, 16))), "instance_ids is float64 (3, 12,"),
        (_put("instance_ids", 9), "an instance id is 9, but it has 2 objects"),
        (_put("world_to_camera", np.nan), "world_to_camera holds numbers that are not finite"),
        (_put("object_class", 99), "object_class is not below 22, the size of its label set"),
        (_set("image_size", "big"), "invalid literal for int()"),
        (_set("image_size", (16, 12)), "instance_ids has shape (3, 12, 16), expected (3, 16, 12)"),
        (_put("ground_truth/centers_m", np.inf), "centers_m holds numbers that are not finite"),
        (_set("model_ids", "[1, 2", "ground_truth"), "Expecting"),
        (_set("model_ids", '["a"]', "ground_truth"), "it has 1 model_ids"),
        (_set("model_ids", '["a", "../b", ""]', "ground_truth"), "'../b' names no model"),
        (_set("height_m", np.nan, "ground_truth"), "height_m is nan"),
    ],
)  # fmt: skip
def test_contents_of_another_format_name_file_and_room(tmp_path, change, said):
    path = tmp_path / "a.h5"
    write_shard(path, "front3d_bedroom", [(make_room(), make_truth())])
    with h5py.File(path, "r+") as file:
        change(file["rooms/house_A"])
    with pytest.raises(ShardError) as error, Shard(path) as shard:
        shard.read_room("house_A", images=True)
        shard.read_ground_truth("house_A")
    assert str(error.value).startswith(f"{path}, room house_A cannot be read (")
    assert said in str(error.value)
    if "instance id" in said or said.startswith(("instance_ids claims", "instance_ids is")):
        with pytest.raises(ShardError, match="room house_A"), Shard(path) as shard:
            shard.read_instance_ids("house_A", [0])


def test_attributes_of_another_format_name_the_file(tmp_path):
    path = tmp_path / "a.h5"
    for group, name, value in (
        ("/", "label_set", 3), ("/", "label_set", "unheard"), ("/", "format", [1, 2]),
        ("rooms/house_A", "room_id", b"\xff"), ("rooms/house_A", "room_id", 7),
    ):  # fmt: skip
        write_shard(path, "front3d_bedroom", [(make_room(), None)])
        with h5py.File(path, "r+") as file:
            file[group].attrs[name] = value
        with pytest.raises(ShardError, match=r"a\.h5 (cannot be read|says format)"):
            Shard(path)


def test_the_turn_of_a_room_is_an_attribute_of_turned_rooms_only(tmp_path):
    path, matrix = tmp_path / "a.h5", np.eye(4)
    matrix[:3, 3] = 0.1, 0.2, 0.3
    room = make_room()
    turned = replace(room, room_id="turned", turned_deg=-33.25, room_from_world=matrix)
    write_shard(path, "front3d_bedroom", [(room, None), (turned, None)])
    assert room_checksum(turned, None) != room_checksum(replace(turned, turned_deg=1.0), None)
    with Shard(path) as shard:
        assert_same(shard.read_room("turned", images=True), turned)
        read = shard.read_room("turned", images=True)
        assert shard.read_checksum("turned") == room_checksum(read, None)
    with h5py.File(path, "a") as file:
        assert set(file["rooms/house_A"].attrs) == {"room_id", "image_size", "sha256"}
        file["rooms/turned"].attrs["room_from_world"] = np.full((4, 4), np.nan)
    message = (
        r"room turned cannot be read \(turned_deg -33\.25 and room_from_world .* are no turn\)"
    )
    with Shard(path) as shard, pytest.raises(ShardError, match=message):
        shard.read_room("turned")
