"""Whole data sets: reproducible, split nine to one, there whole or not at all, faces right."""

import csv
import errno
import hashlib
from collections import Counter

import numpy as np
import pytest
import trimesh
from homes_on_disk import TYPES
from shapely.geometry import LineString, Point

from data_prep.homes.make import make_homes
from sceneprior.core.classes import LABEL_SETS
from sceneprior.core.errors import InputError
from sceneprior.core.files import only_writer
from sceneprior.furniture.catalog import make_catalog


@pytest.mark.parametrize("room_type", TYPES)
def test_the_same_seed_writes_the_same_bytes(tmp_path, room_type):
    digests = []
    for name in ("first", "second"):
        make_catalog.cache_clear()
        make_homes(tmp_path / name, 10, room_type, seed=3)
        digest = hashlib.sha256()
        for path in sorted((tmp_path / name).rglob("*")):
            digest.update(str(path.relative_to(tmp_path / name)).encode())
            digest.update(path.read_bytes() if path.is_file() else b"")
        digests.append(digest.hexdigest())
    assert digests[0] == digests[1]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["first", "second"]


def test_another_seed_writes_other_rooms_and_a_longer_run_the_same_first_rooms(homes, tmp_path):
    make_homes(tmp_path / "short", 6, "bedroom", seed=0)
    make_homes(tmp_path / "other", 6, "bedroom", seed=3)
    short, long, other = (
        {path.name: path.read_bytes() for path in (folder / "3D-FRONT").iterdir()}
        for folder in (tmp_path / "short", homes["bedroom"], tmp_path / "other")
    )
    assert not set(long) & set(other)
    # The last house of the short run may have been cut before its last room.
    assert sum(long.get(name) == content for name, content in short.items()) >= len(short) - 1


@pytest.mark.parametrize("room_type", TYPES)
def test_split_lists_every_room_once_seven_to_one_to_two(homes, rooms, room_type):
    text = (homes[room_type] / "splits" / f"{room_type}.csv").read_text()
    listed = dict(csv.reader(text.splitlines()))
    assert len(listed) == 400 == len(text.splitlines())
    assert set(listed) == {room["id"] for room in rooms[room_type]}
    assert Counter(listed.values()) == {"train": 280, "val": 40, "test": 80}
    instance_ids = [name.split("_", 1)[1] for name in listed]
    assert len(set(instance_ids)) == 400
    several = Counter(Counter(room["house"] for room in rooms[room_type]).values())
    assert set(several) == {1, 2, 3, 4}
    share = 1 - several[1] / several.total()
    assert 0.15 < share < 0.35  # a quarter of about 290 houses: three deviations are 0.08


def test_bad_input_is_one_sentence_and_leaves_nothing(tmp_path):
    full = tmp_path / "full"
    full.mkdir()
    (full / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="already holds files; choose another folder"):
        make_homes(full, 4, "bedroom", 0)
    with pytest.raises(InputError, match="is a file; choose a new folder"):
        make_homes(full / "notes.txt", 4, "bedroom", 0)
    with pytest.raises(InputError, match="at least 2 rooms"):
        make_homes(tmp_path / "new", 1, "bedroom", 0)
    with pytest.raises(InputError, match="choose one of bedroom, living"):
        make_homes(tmp_path / "new", 4, "kitchen", 0)
    with pytest.raises(NotADirectoryError, match="new"):
        make_homes(full / "notes.txt" / "new", 4, "bedroom", 0)
    assert [path.name for path in tmp_path.iterdir()] == ["full"]


def test_a_second_writer_of_one_folder_is_refused(tmp_path):
    with only_writer(tmp_path / "new"), pytest.raises(InputError, match="Another run is writing"):
        make_homes(tmp_path / "new", 2, "bedroom", 0)
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_an_error_that_names_the_folder_and_leaves_nothing(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")  # as `write` raises it: no name

    monkeypatch.setattr("data_prep.homes.make._write_split", full)
    with pytest.raises(OSError, match="No space left") as error:
        make_homes(tmp_path / "new", 2, "living", 0)
    assert error.value.filename == str(tmp_path / "new") and not list(tmp_path.iterdir())


@pytest.mark.parametrize(("room_type", "label_set"), TYPES.items())
def test_every_class_occurs_in_five_variants_or_more(rooms, room_type, label_set):
    jids: dict[str, set] = {}
    for room in rooms[room_type]:
        for piece in room["pieces"]:
            jids.setdefault(piece["class"], set()).add(piece["jid"])
    assert set(jids) == set(LABEL_SETS[label_set][1:])
    catalog = make_catalog(0, label_set)
    assert all(len({model.jid for model in models}) >= 5 for models in catalog.values())


def test_command_writes_into_an_empty_folder(tmp_path, cli):
    result = cli("make-homes", tmp_path, "--rooms", 3, "--room-type", "living", "--seed", 3)
    assert result.exit_code == 0, result.output
    assert "3 living rooms" in result.output
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["3D-FRONT", "3D-FUTURE-model", "splits"]


def test_models_on_disk_load_as_they_were_built(homes):
    folder = homes["bedroom"] / "3D-FUTURE-model"
    for models in make_catalog(0, "front3d_bedroom").values():
        loaded = trimesh.load_mesh(folder / models[0].jid / "raw_model.obj", process=False)
        np.testing.assert_allclose(loaded.bounds, models[0].mesh.bounds, atol=6e-5)
        assert len(loaded.faces) == len(models[0].mesh.faces)


@pytest.mark.parametrize("room_type", TYPES)
def test_floor_looks_up_walls_look_in_and_outer_walls_out(rooms, room_type):
    for room in rooms[room_type][:60]:
        kinds = {"Floor", "Ceiling", "WallInner", "WallOuter", "Door"}
        assert {m["type"] for m in room["meshes"]} == kinds
        for mesh in room["meshes"]:
            points = np.reshape(mesh["xyz"], (-1, 3))[np.reshape(mesh["faces"], (-1, 3))]
            normal = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            np.testing.assert_allclose(normal, np.reshape(mesh["normal"], (-1, 3))[::3], atol=1e-4)
            if mesh["type"] in ("Floor", "Ceiling"):
                assert np.all(normal[:, 1] == (1 if mesh["type"] == "Floor" else -1))
                continue
            step = points.mean(axis=(0, 1)) + 0.05 * normal[0]
            inside = room["floor"].contains(Point(step[[0, 2]]))
            assert inside == (mesh["type"] in ("WallInner", "Door"))


@pytest.mark.parametrize("room_type", TYPES)
def test_a_door_is_in_a_wall_and_no_furniture_stands_before_it(rooms, room_type):
    for room in rooms[room_type]:
        (door,) = (mesh for mesh in room["meshes"] if mesh["type"] == "Door")
        points = np.reshape(door["xyz"], (-1, 3))
        base = LineString(np.unique(points[points[:, 1] == 0][:, [0, 2]], axis=0))
        assert base.length == pytest.approx(0.9) and points[:, 1].max() == 2.0
        assert max(room["floor"].exterior.distance(Point(xy)) for xy in base.coords) < 0.006
        before = base.buffer(0.3, cap_style="flat")
        standing = [p["footprint"] for p in room["pieces"] if p["levels"][0] < 0.5]
        assert not any(before.intersection(piece).area > 1e-6 for piece in standing)
