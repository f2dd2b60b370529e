"""Homes made from a seed, read back as any reader of 3D-FRONT would: bytes, contents, places."""

import errno
import hashlib
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from golden_values import hold
from homes_on_disk import TYPES, read_rooms
from refusals import refused
from shapely.geometry import LineString, Point

from data_prep.homes.bedroom import BEDROOM
from data_prep.homes.furnish import furnish
from data_prep.homes.layout import FREE_SHARE
from data_prep.homes.make import make_homes
from sceneprior.core.files import only_writer
from sceneprior.furniture.catalog import make_catalog

both_types = pytest.mark.parametrize("room_type", TYPES)


@pytest.fixture(scope="module", params=TYPES)
def rooms(request, made_once):
    """Sixty rooms of one type, as read back from disk."""
    folder = made_once(f"homes_{request.param}", lambda f: make_homes(f, 60, request.param, seed=0))
    return read_rooms(folder, request.param)


@both_types
def test_a_seed_writes_the_same_bytes_as_ever(tmp_path, room_type):
    for seed in (0, 3, 7):
        make_homes(tmp_path / f"{seed}", 12, room_type, seed=seed)
        digest = hashlib.sha256()
        for path in sorted((tmp_path / f"{seed}").rglob("*")):
            digest.update(str(path.relative_to(tmp_path)).encode())
            digest.update(path.read_bytes() if path.is_file() else b"")
        hold("homes", {f"{room_type} {seed}": digest.hexdigest()})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0", "3", "7"]


def test_a_longer_run_begins_with_the_same_rooms(rooms, tmp_path):
    room_type = "living" if "Living" in rooms[0]["type"] else "bedroom"
    make_homes(tmp_path / "short", 6, room_type, seed=0)
    short = read_rooms(tmp_path / "short", room_type)
    assert sum(room in rooms for room in short) >= len(short) - 1  # the last house may be cut


def test_bad_input_is_one_sentence_and_leaves_nothing(tmp_path):
    full = tmp_path / "full"
    full.mkdir()
    (full / "notes.txt").write_text("mine")
    for name, folder, rooms, room_type in (
        ("full", full, 4, "bedroom"), ("file", full / "notes.txt", 4, "bedroom"),
        ("one room", tmp_path / "new", 1, "bedroom"), ("kitchen", tmp_path / "new", 4, "kitchen"),
    ):  # fmt: skip
        with refused(f"homes/{name}", tmp=tmp_path):
            make_homes(folder, rooms, room_type, 0)
    with pytest.raises(NotADirectoryError, match="new"):
        make_homes(full / "notes.txt" / "new", 4, "bedroom", 0)
    with only_writer(tmp_path / "new"), pytest.raises(Exception, match="Another run is writing"):
        make_homes(tmp_path / "new", 2, "bedroom", 0)
    assert [path.name for path in tmp_path.iterdir()] == ["full"]


def test_a_full_disk_is_an_error_that_names_the_folder_and_leaves_nothing(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")  # as `write` raises it: no name

    monkeypatch.setattr("data_prep.homes.make._write_split", full)
    with pytest.raises(OSError, match="No space left") as error:
        make_homes(tmp_path / "new", 2, "living", 0)
    assert error.value.filename == str(tmp_path / "new") and not list(tmp_path.iterdir())


def test_command_writes_into_an_empty_folder(tmp_path, cli):
    result = cli("make-homes", tmp_path, "--rooms", 3, "--room-type", "living", "--seed", 3)
    assert result.exit_code == 0, result.output
    assert "3 living rooms" in result.output
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["3D-FRONT", "3D-FUTURE-model", "splits"]


def test_floor_looks_up_walls_look_in_and_outer_walls_out(rooms):
    for room in rooms:
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


def test_a_door_is_in_a_wall_and_no_furniture_stands_before_it(rooms):
    for room in rooms:
        (door,) = (mesh for mesh in room["meshes"] if mesh["type"] == "Door")
        points = np.reshape(door["xyz"], (-1, 3))
        base = LineString(np.unique(points[points[:, 1] == 0][:, [0, 2]], axis=0))
        assert base.length == pytest.approx(0.9) and points[:, 1].max() == 2.0
        assert max(room["floor"].exterior.distance(Point(xy)) for xy in base.coords) < 0.006
        before = base.buffer(0.3, cap_style="flat")
        standing = [p["footprint"] for p in room["pieces"] if p["levels"][0] < 0.5]
        assert not any(before.intersection(piece).area > 1e-6 for piece in standing)


def test_a_room_for_which_no_place_is_found_is_an_error():
    hopeless = replace(BEDROOM, place_first=lambda furnisher, groups: None)
    catalog = make_catalog(0, "front3d_bedroom")
    with pytest.raises(
        RuntimeError, match=r"No bedroom could hold these 5 pieces in 400 tries: \['"
    ):
        furnish(hopeless, catalog, np.random.default_rng(0), 0.5)


CEILING_CLASSES = {"pendant_lamp", "ceiling_lamp"}


def test_no_boxes_intersect_and_all_stand_inside(rooms):
    for room in rooms:
        for a, b in combinations(room["pieces"], 2):
            if min(a["levels"][1], b["levels"][1]) - max(a["levels"][0], b["levels"][0]) > 1e-4:
                assert a["footprint"].intersection(b["footprint"]).area == 0, room["id"]
        inside = room["floor"].buffer(1e-4)  # coordinates are rounded to 1e-5
        for piece in room["pieces"]:
            assert inside.contains(piece["footprint"]), (room["id"], piece["class"])
            assert piece["levels"][1] <= room["height"] + 1e-3
            if piece["class"] in CEILING_CLASSES:
                assert piece["levels"][1] == pytest.approx(room["height"], abs=1e-3)
                assert piece["levels"][0] > 1.0
            else:
                assert piece["levels"][0] == pytest.approx(0, abs=1e-4)


def test_rooms_have_room_to_walk_and_pass_atiss_filters(rooms):
    side, most = (12, 21) if "Living" in rooms[0]["type"] else (6, 13)
    for room in rooms:
        x0, z0, x1, z1 = room["floor"].bounds
        assert max(x1 - x0, z1 - z0) <= side
        assert 2.6 <= room["height"] <= 3.0
        assert 2 <= len(room["pieces"]) <= most
        assert room["floor"].area == pytest.approx(room["size"], abs=0.01)
        standing = [p["footprint"].area for p in room["pieces"] if p["levels"][0] < 0.5]
        assert sum(standing) <= (1 - FREE_SHARE) * room["floor"].area + 1e-3
