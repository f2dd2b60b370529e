"""Homes made from a seed, read back as any reader of 3D-FRONT would: bytes, contents, places."""

import csv
import errno
import hashlib
from collections import Counter
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import trimesh
from golden import hold
from homes_on_disk import BEDS, TYPES
from refusals import refused
from shapely.geometry import LineString, Point

from data_prep.homes.bedroom import BEDROOM
from data_prep.homes.bedroom import COUNTS as BEDROOM_COUNTS
from data_prep.homes.furnish import furnish
from data_prep.homes.layout import FREE_SHARE
from data_prep.homes.living import COUNTS as LIVING_COUNTS
from data_prep.homes.make import make_homes
from sceneprior.core.classes import LABEL_SETS
from sceneprior.core.files import only_writer
from sceneprior.furniture.catalog import make_catalog

both_types = pytest.mark.parametrize("room_type", TYPES)


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


def test_a_longer_run_begins_with_the_same_rooms(homes, tmp_path):
    make_homes(tmp_path / "short", 6, "bedroom", seed=0)
    short, long = (
        {path.name: path.read_bytes() for path in (folder / "3D-FRONT").iterdir()}
        for folder in (tmp_path / "short", homes["bedroom"])
    )
    # The last house of the short run may have been cut before its last room.
    assert sum(long.get(name) == content for name, content in short.items()) >= len(short) - 1


@both_types
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


@both_types
def test_every_class_occurs_in_five_variants_or_more_as_it_was_built(homes, rooms, room_type):
    label_set = TYPES[room_type]
    used = {piece["class"] for room in rooms[room_type] for piece in room["pieces"]}
    assert used == set(LABEL_SETS[label_set][1:])
    for models in make_catalog(0, label_set).values():
        assert len({model.jid for model in models}) >= 5
        path = homes[room_type] / "3D-FUTURE-model" / models[0].jid / "raw_model.obj"
        loaded = trimesh.load_mesh(path, process=False)
        np.testing.assert_allclose(loaded.bounds, models[0].mesh.bounds, atol=6e-5)
        assert len(loaded.faces) == len(models[0].mesh.faces)


def test_command_writes_into_an_empty_folder(tmp_path, cli):
    result = cli("make-homes", tmp_path, "--rooms", 3, "--room-type", "living", "--seed", 3)
    assert result.exit_code == 0, result.output
    assert "3 living rooms" in result.output
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["3D-FRONT", "3D-FUTURE-model", "splits"]


@both_types
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


@both_types
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


@pytest.mark.parametrize(
    ("room_type", "histogram"), [("bedroom", BEDROOM_COUNTS), ("living", LIVING_COUNTS)]
)
def test_object_counts_follow_the_histogram(rooms, room_type, histogram):
    counts = np.array([len(room["pieces"]) for room in rooms[room_type]])
    cumulative = np.cumsum(list(histogram.values())) / sum(histogram.values())
    ours = [np.mean(counts <= count) for count in histogram]
    # Golden-ratio multiples leave at most a few of 400 rooms on the wrong side of a step.
    np.testing.assert_allclose(ours, cumulative, atol=0.012)
    mean = sum(k * v for k, v in histogram.items()) / sum(histogram.values())
    assert counts.mean() == pytest.approx(mean, abs=0.1)


def test_a_room_for_which_no_place_is_found_is_an_error():
    hopeless = replace(BEDROOM, place_first=lambda furnisher, groups: None)
    catalog = make_catalog(0, "front3d_bedroom")
    with pytest.raises(
        RuntimeError, match=r"No bedroom could hold these 5 pieces in 400 tries: \['"
    ):
        furnish(hopeless, catalog, np.random.default_rng(0), 0.5)


CEILING_CLASSES = {"pendant_lamp", "ceiling_lamp"}


@both_types
def test_no_boxes_intersect_and_all_stand_inside(rooms, room_type):
    for room in rooms[room_type]:
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


def _is_angled(piece: dict) -> bool:
    return abs((np.degrees(piece["yaw"]) + 45) % 90 - 45) > 1


@both_types
def test_one_piece_in_ten_stands_askew_and_none_of_those_on_walls(rooms, room_type):
    pieces = [piece for room in rooms[room_type] for piece in room["pieces"]]
    assert 0.05 < np.mean([_is_angled(piece) for piece in pieces]) < 0.15
    upright = BEDS | {"wardrobe", "cabinet", "bookshelf", "tv_stand", "nightstand", "desk", "sofa"}
    assert not any(_is_angled(piece) for piece in pieces if piece["class"] in upright)


@both_types
def test_rooms_have_room_to_walk_and_pass_atiss_filters(rooms, room_type):
    side, most = {"bedroom": (6, 13), "living": (12, 21)}[room_type]
    for room in rooms[room_type]:
        x0, z0, x1, z1 = room["floor"].bounds
        assert max(x1 - x0, z1 - z0) <= side
        assert 2.6 <= room["height"] <= 3.0
        assert 2 <= len(room["pieces"]) <= most
        assert room["floor"].area == pytest.approx(room["size"], abs=0.01)
        standing = [p["footprint"].area for p in room["pieces"] if p["levels"][0] < 0.5]
        assert sum(standing) <= (1 - FREE_SHARE) * room["floor"].area + 1e-3


def test_bedrooms_hold_one_bed_with_its_headboard_on_a_wall(rooms):
    kinds = Counter()
    for room in rooms["bedroom"]:
        beds = [piece for piece in room["pieces"] if piece["class"] in BEDS]
        assert len(beds) == 1, room["id"]
        kinds[beds[0]["class"]] += 1
        for corner in beds[0]["corners"][:2]:  # the two at -z: the head
            assert room["floor"].exterior.distance(Point(corner)) < 0.04
    # Five standard deviations of 400 draws are 0.11, 0.10, 0.08.
    assert kinds["double_bed"] / 400 == pytest.approx(0.70, abs=0.11)
    assert kinds["single_bed"] / 400 == pytest.approx(0.18, abs=0.10)
    assert kinds["kids_bed"] / 400 == pytest.approx(0.12, abs=0.08)


def test_nightstands_stand_beside_the_bed(rooms):
    for room in rooms["bedroom"]:
        bed = next(piece for piece in room["pieces"] if piece["class"] in BEDS)
        for piece in room["pieces"]:
            if piece["class"] == "nightstand":
                assert piece["footprint"].distance(bed["footprint"]) < 0.13
                assert np.cos(piece["yaw"] - bed["yaw"]) > 0.999


def test_chairs_stand_by_their_tables(rooms):
    ringed = 0
    for room in rooms["living"]:
        dining = [p for p in room["pieces"] if p["class"] == "table" and p["footprint"].area > 0.5]
        chairs = [piece for piece in room["pieces"] if piece["class"] == "chair"]
        close = sum(
            any(c["footprint"].distance(t["footprint"]) < 0.15 for t in dining) for c in chairs
        )
        ringed += close >= 2
    assert ringed > 200
