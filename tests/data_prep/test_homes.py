"""Homes that the package makes: read back from disk, as any reader of 3D-FRONT would."""

import csv
import hashlib
import json
from collections import Counter
from importlib.resources import files
from itertools import combinations
from pathlib import Path
from statistics import median

import numpy as np
import pytest
import trimesh
import typer
from shapely.geometry import Point, Polygon
from typer.testing import CliRunner

from data_prep.homes import make_homes
from data_prep.homes.bedroom import COUNTS as BEDROOM_COUNTS
from data_prep.homes.catalog import at_score, catalogue, real_sizes
from data_prep.homes.command import make_homes_command
from data_prep.homes.living import COUNTS as LIVING_COUNTS
from data_prep.homes.rooms import FREE_SHARE, count_at
from sceneprior.classes import LABEL_SETS
from sceneprior.errors import InputError

TYPES = {"bedroom": "front3d_bedroom", "living": "front3d_living"}
BEDS = {"double_bed", "single_bed", "kids_bed"}
CEILING_CLASSES = {"pendant_lamp", "ceiling_lamp"}


@pytest.fixture(scope="module")
def homes(tmp_path_factory):
    """Room type -> folder of 400 rooms, the size the demo makes."""
    folder = tmp_path_factory.mktemp("homes")
    for room_type in TYPES:
        make_homes(folder / room_type, 400, room_type, seed=0)
    return {room_type: folder / room_type for room_type in TYPES}


@pytest.fixture(scope="module")
def rooms(homes):
    """Room type -> every room as read back from disk."""
    return {room_type: read_rooms(folder, room_type) for room_type, folder in homes.items()}


def class_of_category(room_type: str) -> dict[str, str]:
    column = {"bedroom": "bedroom_class", "living": "living_room_class"}[room_type]
    table = files("sceneprior").joinpath("front3d_categories.csv").read_text()
    return {row["model_info_category"]: row[column] for row in csv.DictReader(table.splitlines())}


def read_rooms(folder: Path, room_type: str) -> list[dict]:
    """Rooms with their floor polygon and, for each piece, class, oriented footprint and levels."""
    classes = class_of_category(room_type)
    info = json.loads((folder / "3D-FUTURE-model" / "model_info.json").read_text())
    names = {
        record["model_id"]: classes[record["category"].lower().replace(" / ", "/")]
        for record in info
    }
    bounds = {}
    for jid in names:
        lines = (folder / "3D-FUTURE-model" / jid / "raw_model.obj").read_text().splitlines()
        points = np.array([line.split()[1:] for line in lines if line.startswith("v ")], float)
        bounds[jid] = (points.min(axis=0), points.max(axis=0))
    found = []
    for path in sorted((folder / "3D-FRONT").glob("*.json")):
        house = json.loads(path.read_text())
        assert house["uid"] == path.stem
        furniture = {entry["uid"]: entry for entry in house["furniture"]}
        meshes = {entry["uid"]: entry for entry in house["mesh"]}
        for room in house["scene"]["room"]:
            own = [meshes[c["ref"]] for c in room["children"] if c["ref"] in meshes]
            floor = [mesh for mesh in own if mesh["type"] == "Floor"]
            pieces = []
            for child in room["children"]:
                if child["ref"] in furniture:
                    assert furniture[child["ref"]]["valid"] is True
                    jid = furniture[child["ref"]]["jid"]
                    pieces.append(_piece(names[jid], *bounds[jid], child) | {"jid": jid})
            found.append(
                {
                    "id": f"{house['uid']}_{room['instanceid']}",
                    "house": house["uid"],
                    "type": room["type"],
                    "size": room["size"],
                    "floor": _floor(floor),
                    "height": max(max(mesh["xyz"][1::3]) for mesh in own),
                    "meshes": own,
                    "pieces": pieces,
                }
            )
    return found


def _piece(name: str, low: np.ndarray, high: np.ndarray, child: dict) -> dict:
    x, y, z, w = child["rot"]
    assert x == z == 0
    assert np.isclose(y * y + w * w, 1, atol=1e-4)
    yaw = 2 * np.arctan2(y, w)
    scale = np.array(child["scale"])
    low, high = low * scale, high * scale
    corners = [(low[0], low[2]), (high[0], low[2]), (high[0], high[2]), (low[0], high[2])]
    sin, cos = np.sin(yaw), np.cos(yaw)
    px, py, pz = child["pos"]
    turned = [(px + a * cos + b * sin, pz - a * sin + b * cos) for a, b in corners]
    return {
        "class": name,
        "yaw": yaw,
        "corners": turned,
        "footprint": Polygon(turned),
        "levels": (py + low[1], py + high[1]),
    }


def _floor(meshes: list[dict]) -> Polygon:
    points = np.concatenate([np.reshape(mesh["xyz"], (-1, 3)) for mesh in meshes])
    faces = np.reshape(meshes[0]["faces"], (-1, 3))
    union = Polygon()
    for face in faces:
        union = union.union(Polygon(points[face][:, [0, 2]]))
    return union


def _is_angled(piece: dict) -> bool:
    return abs((np.degrees(piece["yaw"]) + 45) % 90 - 45) > 1


@pytest.mark.parametrize("room_type", TYPES)
def test_the_same_seed_writes_the_same_bytes(tmp_path, room_type):
    digests = []
    for name in ("first", "second"):
        catalogue.cache_clear()
        make_homes(tmp_path / name, 25, room_type, seed=3)
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
def test_split_lists_every_room_once_nine_to_one(homes, rooms, room_type):
    text = (homes[room_type] / "splits" / f"{room_type}.csv").read_text()
    listed = dict(csv.reader(text.splitlines()))
    assert len(listed) == 400 == len(text.splitlines())
    assert set(listed) == {room["id"] for room in rooms[room_type]}
    assert Counter(listed.values()) == {"train": 360, "test": 40}
    instance_ids = [name.split("_", 1)[1] for name in listed]
    assert len(set(instance_ids)) == 400
    several = Counter(Counter(room["house"] for room in rooms[room_type]).values())
    assert set(several) == {1, 2, 3, 4}
    share = 1 - several[1] / several.total()
    assert 0.15 < share < 0.35  # a quarter of about 290 houses: three deviations are 0.08


@pytest.mark.parametrize("room_type", TYPES)
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


@pytest.mark.parametrize("room_type", TYPES)
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


def test_nightstands_stand_beside_the_bed_and_chairs_by_their_tables(rooms):
    for room in rooms["bedroom"]:
        bed = next(piece for piece in room["pieces"] if piece["class"] in BEDS)
        for piece in room["pieces"]:
            if piece["class"] == "nightstand":
                assert piece["footprint"].distance(bed["footprint"]) < 0.13
                assert np.cos(piece["yaw"] - bed["yaw"]) > 0.999
    ringed = 0
    for room in rooms["living"]:
        dining = [p for p in room["pieces"] if p["class"] == "table" and p["footprint"].area > 0.5]
        chairs = [piece for piece in room["pieces"] if piece["class"] == "chair"]
        close = sum(
            any(c["footprint"].distance(t["footprint"]) < 0.15 for t in dining) for c in chairs
        )
        ringed += close >= 2
    assert ringed > 200


@pytest.mark.parametrize("room_type", TYPES)
def test_one_piece_in_ten_stands_askew_and_none_of_those_on_walls(rooms, room_type):
    pieces = [piece for room in rooms[room_type] for piece in room["pieces"]]
    assert 0.05 < np.mean([_is_angled(piece) for piece in pieces]) < 0.15
    upright = BEDS | {"wardrobe", "cabinet", "bookshelf", "tv_stand", "nightstand", "desk", "sofa"}
    assert not any(_is_angled(piece) for piece in pieces if piece["class"] in upright)


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


def test_count_at_walks_up_the_histogram():
    shares = (0, 0.24, 0.25, 0.74, 0.75, 0.999)
    counts = [count_at({2: 1, 5: 2, 6: 1}, share) for share in shares]
    assert counts == [2, 2, 5, 5, 6, 6]


@pytest.mark.parametrize(("room_type", "label_set"), TYPES.items())
def test_every_class_occurs_in_five_variants_or_more(rooms, room_type, label_set):
    jids: dict[str, set] = {}
    for room in rooms[room_type]:
        for piece in room["pieces"]:
            jids.setdefault(piece["class"], set()).add(piece["jid"])
    assert set(jids) == set(LABEL_SETS[label_set][1:])
    shop = catalogue(0, label_set)
    assert all(len({model.jid for model in models}) >= 5 for models in shop.values())


def test_sizes_keep_to_the_real_percentiles():
    for name, models in catalogue(0, "front3d_bedroom").items():
        for axis, (low, middle, high) in enumerate(real_sizes()[name]):
            sizes = [model.size_m[axis] for model in models]
            # An even dozen has no model at the median itself: the middle two straddle it.
            assert median(sizes) == pytest.approx(middle, rel=0.15), (name, axis)
            assert low < median(sizes) < high
            assert sum(low <= size <= high for size in sizes) >= 10
    assert [at_score(1, 2, 6, score) for score in (-1.2816, 0, 1.2816)] == pytest.approx([1, 2, 6])


@pytest.mark.parametrize("seed", [0, 3])
def test_furniture_is_closed_faces_outward_and_stands_on_the_floor(seed):
    for models in catalogue(seed, "front3d_bedroom").values():
        for model in models:
            for part in model.parts:
                assert part.is_watertight, model
                assert part.is_winding_consistent
                assert part.volume > 0
            low, high = model.mesh.bounds
            np.testing.assert_allclose(high - low, model.size_m, atol=1e-9)
            np.testing.assert_allclose(low + high, [0, model.size_m[1], 0], atol=1e-9)
            assert 40 <= len(model.mesh.faces) <= 4000


def test_models_on_disk_load_as_they_were_built(homes):
    folder = homes["bedroom"] / "3D-FUTURE-model"
    for models in catalogue(0, "front3d_bedroom").values():
        loaded = trimesh.load_mesh(folder / models[0].jid / "raw_model.obj", process=False)
        np.testing.assert_allclose(loaded.bounds, models[0].mesh.bounds, atol=6e-5)
        assert len(loaded.faces) == len(models[0].mesh.faces)


@pytest.mark.parametrize("room_type", TYPES)
def test_floor_looks_up_walls_look_in_and_outer_walls_out(rooms, room_type):
    for room in rooms[room_type][:60]:
        assert {m["type"] for m in room["meshes"]} == {"Floor", "Ceiling", "WallInner", "WallOuter"}
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
            assert inside == (mesh["type"] == "WallInner")


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
    with pytest.raises(InputError, match="A seed is 0 or more"):
        make_homes(tmp_path / "new", 4, "bedroom", -1)
    with pytest.raises(InputError, match="Cannot write beside"):
        make_homes(full / "notes.txt" / "new", 4, "bedroom", 0)
    assert [path.name for path in tmp_path.iterdir()] == ["full"]


def test_an_interrupted_run_leaves_nothing(tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("data_prep.homes.make._write_split", interrupt)
    with pytest.raises(KeyboardInterrupt):
        make_homes(tmp_path / "new", 2, "living", 0)
    assert not list(tmp_path.iterdir())


def test_command_writes_into_an_empty_folder(tmp_path):
    app = typer.Typer()
    app.command()(make_homes_command)
    arguments = [str(tmp_path), "--rooms", "3", "--room-type", "living", "--seed", "3"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "3 living rooms" in result.output
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["3D-FRONT", "3D-FUTURE-model", "splits"]
