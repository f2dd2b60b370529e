"""Homes made from a seed, read back as any reader of 3D-FRONT would: bytes, contents, places."""

import errno
import hashlib
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import shapely
from golden_values import hold
from refusals import refused

from data_prep.front.furnished import ModelBank, Room
from data_prep.front.houses import read_house
from data_prep.front.recipe import boxes_m, load_recipe
from data_prep.homes.bedroom import BEDROOM
from data_prep.homes.furnish import furnish
from data_prep.homes.layout import FREE_SHARE, grown
from data_prep.homes.living import LIVING_ROOM, PULLED_OUT_M
from data_prep.homes.make import make_homes
from sceneprior.core.files import only_writer
from sceneprior.furniture.catalog import make_catalog

TYPES = ("bedroom", "living")
both_types = pytest.mark.parametrize("room_type", TYPES)


def read_rooms(folder: Path, room_type: str) -> list[Room]:
    """All rooms, read as 3D-FRONT's are."""
    bank, recipe = ModelBank(folder / "3D-FUTURE-model"), load_recipe(room_type)
    houses = sorted((folder / "3D-FRONT").glob("*.json"))
    return [room for house in houses for room in read_house(house, bank, recipe).rooms]


def footprint(low_m, high_m):
    return shapely.box(low_m[0], low_m[2], high_m[0], high_m[2])


@pytest.fixture(scope="module", params=TYPES)
def rooms(request, made_once):
    """Sixty rooms of one type, as read back from disk."""
    folder = made_once(f"homes_{request.param}", lambda f: make_homes(f, 60, request.param, seed=0))
    found = read_rooms(folder, request.param)
    assert len(found) == 60
    return found


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


@both_types
def test_a_longer_run_begins_with_the_same_houses(tmp_path, room_type):
    written = []
    for rooms in (4, 8):
        make_homes(tmp_path / f"{rooms}", rooms, room_type, seed=0)
        houses = (tmp_path / f"{rooms}" / "3D-FRONT").glob("*.json")
        written.append({path.name: path.read_text() for path in houses})
    short, long = written
    assert sum(long.get(name) == text for name, text in short.items()) >= len(short) - 1


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


def test_walls_look_in_and_no_furniture_stands_before_the_door(rooms):
    for room in rooms:
        assert set(room.shell) == {"floor", "wall", "door", "window", "ceiling"} and not room.notes
        for kind, triangles in room.shell.items():
            normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            if kind in ("floor", "ceiling"):
                assert np.allclose(normal[:, 1], 1 if kind == "floor" else -1)
                continue
            steps = triangles.mean(axis=1) + 0.05 * normal
            assert shapely.covers(room.floor, shapely.points(steps[:, [0, 2]])).all()
        points = room.shell["door"].reshape(-1, 3)
        assert points[:, 1].max() == pytest.approx(2.0, abs=1e-4)
        low, high = points[:, [0, 2]].min(axis=0), points[:, [0, 2]].max(axis=0)
        base = shapely.LineString([low, high])
        assert base.length == pytest.approx(0.9, abs=1e-4)
        assert max(room.floor.exterior.distance(shapely.Point(end)) for end in (low, high)) < 0.006
        before = base.buffer(0.3, cap_style="flat")
        for low_m, high_m in boxes_m(room):
            if low_m[1] < 0.5:
                assert before.intersection(footprint(low_m, high_m)).area < 1e-6


def test_a_room_for_which_no_place_is_found_is_an_error():
    hopeless = replace(BEDROOM, place_first=lambda furnisher, groups: None)
    catalog = make_catalog(0, "front3d_bedroom")
    with pytest.raises(
        RuntimeError, match=r"No bedroom could hold these 5 pieces in 400 tries: \['"
    ):
        furnish(hopeless, catalog, np.random.default_rng(0), 0.5)


def test_boxes_stand_apart_and_inside_with_room_to_walk(rooms):
    side, most = (12, 21) if "Living" in rooms[0].type else (6, 13)
    for room in rooms:
        x0, z0, x1, z1 = room.floor.bounds
        assert max(x1 - x0, z1 - z0) <= side and 2.6 <= room.height_m <= 3.0
        assert 2 <= len(room.furniture) <= most
        boxes = boxes_m(room)
        inside = room.floor.buffer(1e-4)  # coordinates are rounded to 1e-5
        for (low, high), piece in zip(boxes, room.furniture, strict=True):
            assert inside.contains(footprint(low, high)), (room.room_id, piece.label)
            assert high[1] <= room.height_m + 1e-3
            hangs = piece.label in ("pendant_lamp", "ceiling_lamp")
            end, level = (high[1], room.height_m) if hangs else (low[1], 0)
            assert end == pytest.approx(level, abs=1e-3) and low[1] > hangs - 1e-3
        for (low_a, high_a), (low_b, high_b) in combinations(boxes, 2):
            assert (np.minimum(high_a, high_b) - np.maximum(low_a, low_b)).min() < 1e-4
        standing = [
            shapely.MultiPoint(piece.mesh.vertices_m[:, [0, 2]]).convex_hull.area
            for (low, _), piece in zip(boxes, room.furniture, strict=True)
            if low[1] < 0.5
        ]
        assert sum(standing) <= (1 - FREE_SHARE) * room.floor.area + 1e-3


def test_living_rooms_stand_as_people_use_them():
    catalog = make_catalog(0, "front3d_living")
    chairs = coffee_tables = lamps = 0
    for room in range(40):
        layout = furnish(LIVING_ROOM, catalog, np.random.default_rng(room), (room + 0.5) / 40)
        sofa, standing = layout.pieces[0], [each for each in layout.pieces if each.y == 0]
        named = {each.model.name: each for each in standing}
        tables = [each for each in standing if each.model.name in ("table", "coffee_table")]
        dining = [each for each in standing if "Dining Chair" in each.model.category]
        floor = shapely.Polygon(layout.outline)
        for chair in dining:  # it can be pulled out
            others = [each for each in standing if each not in (*dining, *tables)]
            rest = shapely.union_all([shapely.box(*each.rect) for each in others])
            assert shapely.box(*chair.rect).distance(rest) > PULLED_OUT_M - 1e-9
            assert floor.covers(shapely.box(*grown(chair.rect, PULLED_OUT_M - 1e-9)))
        if "tv_stand" in named:
            assert named["tv_stand"].size_m[1] < 0.75
        if "coffee_table" in named:  # before the middle of the sofa
            ahead = np.array([np.sin(sofa.yaw_rad), np.cos(sofa.yaw_rad)])
            away = np.array([named["coffee_table"].x - sofa.x, named["coffee_table"].z - sofa.z])
            assert away @ ahead > 0 and abs(away @ (ahead[1], -ahead[0])) < 0.05
        hanging = np.array([(each.x, each.z) for each in layout.pieces if each.y > 0])
        tops = np.array([(each.x, each.z) for each in tables if each.size_m[0] > 0.5])
        for own, lamp in enumerate(hanging):
            rest = np.delete(hanging, own, axis=0)
            over = len(tops) and np.linalg.norm(tops - lamp, axis=1).min() < 0.2
            assert over or not len(rest) or np.linalg.norm(rest - lamp, axis=1).min() > 1.2
        chairs, lamps = chairs + len(dining), lamps + len(hanging)
        coffee_tables += "coffee_table" in named
    assert chairs > 50 and coffee_tables > 30 and lamps > 30
