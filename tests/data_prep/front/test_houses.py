"""Houses read from disk, a case for each quirk of the real ones; the rooms are in a golden file."""

import json
import math

import numpy as np
import pytest
from front_files import FrontFolder, bedroom, room, surface
from front_reading import described, extent, only_room, read, shared_front
from golden_values import hold
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from refusals import refused

from data_prep.front.furnished import ModelBank
from data_prep.front.geometry import floor_of
from data_prep.front.houses import house_files, read_house
from data_prep.front.recipe import load_recipe
from sceneprior.core.errors import InputError

BED = {"jid": "bed", "pos": (0, 0, 0)}


def changed(change, **options):
    """A bedroom after a change of its entry."""

    def rooms(front):
        written = bedroom("A", **options)
        change(written)
        return [written]

    return rooms


def of_pieces(*pieces):
    return lambda front: [room("A", list(pieces))]


def with_mesh(kind, *corners, bounds=(-2.0, -2.0, 2.0, 2.0)):
    def add(written):
        written["_meshes"].append(surface("extra", kind, list(corners)))
        written["children"].append({"ref": "extra"})

    return changed(add, bounds=bounds)


def with_child(key, value):
    return changed(lambda written: written["children"][2].update({key: value}))


def as_text(separator):
    def change(written):
        for mesh in written["_meshes"]:
            for key in ("xyz", "faces"):
                words = [str(value) for value in mesh[key]]
                mesh[key] = separator.join(words) if separator else words
        written["children"][2]["pos"] = ["0.0", "0", "-1.0"]

    return changed(change)


def _damaged_floors(written):
    corners = [(9, 0, 9), (float("nan"), 0, 9), (12, 0, 12), (1e300, 0, 9)]
    written["_meshes"] += [
        surface("broken", "Floor", corners),
        {"uid": "words", "type": "Floor", "xyz": ["a"], "faces": [0, 1, 2]},
    ]
    written["children"] += [{"ref": "broken"}, {"ref": "words"}]


def _odd_meshes(written):
    written["_meshes"] += [
        {"uid": "hollow", "type": "Floor", "xyz": [0, 0, 0], "faces": []},
        {"uid": "typeless", "type": "", "xyz": [0, 0, 0], "faces": [0, 0, 0]},
        {"uid": "wild", "type": "WallInner", "xyz": [0, 9, 0], "faces": [0, 0, 7]},
    ]


def _no_walls(written):
    written["children"] = [c for c in written["children"] if c["ref"] != "wall-A"]


def _ceiling(written):
    corners = [(0, 3.1, 0), (1, 3.1, 0), (1, 3.1, 1), (0, 3.1, 1)]
    written["_meshes"][1] = surface("wall-A", "Ceiling", corners)


def _without_floor(front):
    bare, bad = bedroom("OtherRoom-1"), bedroom("Bad")
    bare["children"] = bare["children"][1:]
    bad["_meshes"][0]["xyz"] = [0.0] * 12
    return [bare, bad, bedroom("Good")]


def _without_furniture(front):
    no_floor = room("Hole", [])
    no_floor["children"] = []
    odd = room("Odd", [BED | {"entry": {"valid": False}}])
    return [room("Bare", []), no_floor, odd]


def _storeys(front):
    below, above = bedroom("Down"), bedroom("Up", floor_y=3.0)
    for child in above["children"]:
        if "pos" in child:
            child["pos"][1] += 3.0
    return [below, above]


def _broken_models(front: FrontFolder):
    front.list_model("ghost", "Desk")
    for name, text in (("empty", "v 0 0 0\n"), ("cut", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n")):
        front.model(name, "Desk", (1, 1, 1))
        (front.future / name / "raw_model.obj").write_text(text)
    return [room("A", [BED | {"jid": jid} for jid in ("bed", "ghost", "empty", "cut", "")])]


def _unknown_models(front: FrontFolder):
    front.model("null", None, (1, 1, 1))
    front.model("odd", "Space Ship", (1, 1, 1))
    return [room("A", [BED | {"jid": "null"}, BED | {"jid": "odd", "pos": (1, 0, 0)}])]


def _huge(front: FrontFolder):
    front.model("huge", "Wardrobe", (150.0, 220.0, 60.0))
    return [room("A", [BED | {"jid": "huge"}])]


def tiny(**entry):
    """A nightstand in centimetres, below 10 m even as metres: told by its stated size."""

    def rooms(front):
        front.model("tiny", "Nightstand", (9.0, 5.0, 8.0))
        piece = {"jid": "tiny", "entry": entry}
        twice = {"pos": (-1.0, 0, 0), "scale": [2, 1, 1]}
        return [room("A", [piece | {"pos": (1.0, 0, 0)}, piece | twice])]

    return rooms


FLAVOURS = (
    BED | {"entry": {"category": "?", "bbox": [9, 9, 9]}},
    {"jid": "stand", "pos": (1.5, 0, 0),
     "entry": {"sourceCategoryId": "x", "title": "y", "size": [9, 9, 9]}},
)  # fmt: skip
CASES = {
    "a plain room off the origin": lambda front: [
        bedroom("Bedroom-7", bounds=(1.0, 2.0, 5.0, 8.0), floor_y=0.5)
    ],
    "both flavours of entries": of_pieces(*FLAVOURS),
    "strings for numbers": as_text(""),
    "one string for all numbers": as_text(","),
    "dangling references": changed(
        lambda written: written["children"].extend(
            [{"ref": "nowhere", "pos": [0, 0, 0]}, {"ref": None}, {}, "junk"]
        )
    ),
    **{
        f"an entry whose valid is {valid!r}": of_pieces(
            BED, {"jid": "stand", "pos": (1.5, 0, 0), "entry": {"valid": valid}}
        )
        for valid in (False, None, "false", 0)
    },
    "a uid twice": changed(
        lambda written: written["_furniture"].append(dict(written["_furniture"][0]))
    ),
    "a piece twice at a place": changed(
        lambda written: written["children"].append(dict(written["children"][2]))
    ),
    "no floor, and a damaged one": _without_floor,
    **{
        f"a placement with {key} {value}": with_child(key, value)
        for key, value in (
            ("pos", [0, float("nan"), 0]), ("rot", [0, 0, 0, 0]), ("scale", [1, 1]), ("scale", {}),
            ("pos", "here"), ("pos", None),
        )
    },
    "a scale of zero": of_pieces(BED, {"jid": "stand", "pos": (1, 0, 0), "scale": [1, 0, 1]}),
    "a mirrored piece": of_pieces(BED | {"scale": [-1, 1, 1]}),
    "rooms without furniture": _without_furniture,
    "rooms whose ids are no names": lambda front: [
        bedroom(name) for name in ("../../up", "a\nb", "x" * 300, "\ud800", "good")
    ],
    "pieces whose ids are no names": of_pieces(
        *(BED | {"jid": jid} for jid in ("bed", "../bed", "\ud800", "\0", "y" * 999))
    ),
    "two rooms of one name": lambda front: [bedroom("A"), bedroom("A")],
    "a quaternion of another length": of_pieces(BED | {"rot": [0, 3, 0, 3]}),
    # The second piece of floor begins after a door sill of 3 cm.
    "two floors with a crack between": with_mesh(
        "Floor", (0.03, 0, -2), (2, 0, -2), (2, 0, 2), (0.03, 0, 2), bounds=(-2.0, -2.0, 0.0, 2.0)
    ),
    "a platform": with_mesh(
        "Floor", (1, 0.2, -2), (2, 0.2, -2), (2, 0.2, 2), (1, 0.2, 2), bounds=(-2.0, -2.0, 1.0, 2.0)
    ),
    "storeys": _storeys,
    "damaged floors": changed(_damaged_floors),
    "odd meshes": changed(_odd_meshes),
    "no walls": changed(_no_walls),
    "a ceiling, no walls": changed(_ceiling),
    "a model a hundred times too large": _huge,
    "a small model in centimetres, by bbox": tiny(bbox=[0.09, 0.05, 0.08]),
    "a small model in centimetres, by size": tiny(size=["0.05", "0.08", "0.09"], bbox=[1]),
    **{
        f"a model in metres whose entry has {entry}": of_pieces(BED | {"entry": entry})
        for entry in (
            {"bbox": [1.9, 1.0, 2.1]}, {"bbox": [180, 100, 200]},
            {"bbox": [0, 0, 0], "size": ["a", 1, 1]}, {"bbox": [float("nan")] * 3, "size": None},
            {"bbox": [0.2, 0.1, 0.1]},
        )
    },
    "missing and broken models": _broken_models,
    "unknown and null categories": _unknown_models,
}  # fmt: skip
RULES = {"a scale of zero": "scale_range=null", "a mirrored piece": "allow_mirrored=false"}


@pytest.mark.parametrize("name", CASES)
def test_a_house_is_read_as_before(front, name):
    path = front.house("house", *CASES[name](front))
    found = {name: described(read(front, path))}
    if rule := RULES.get(name):
        found[f"{name}, {rule}"] = described(read(front, path, (rule,)))
    hold("houses", found, slack=2e-6, tmp=front.root)


def test_entries_that_are_no_objects(front):
    path = front.house("house", bedroom("A"))
    data = json.loads(path.read_text())
    data["furniture"] += [None, 7, "x", {"uid": None}, {"uid": ["a"]}]
    data["mesh"] += [None, [], {"uid": {}}]
    data["scene"]["room"] += [3, {"type": "Bedroom", "instanceid": "B", "children": {"ref": 1}}]
    path.write_text(json.dumps(data))
    hold("houses", {"entries that are no objects": described(read(front, path))}, slack=2e-6)


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(angle=st.floats(-math.pi, math.pi), x=st.floats(-9, 9), z=st.floats(-9, 9))
def test_a_turned_and_moved_house_has_the_same_room_up_to_quarter_turns(front, angle, x, z):
    bounds = (x - 2, z - 3, x + 2, z + 3)
    found = only_room(front, front.house("turned", bedroom("A", bounds=bounds, yaw_rad=angle)))
    x1, z1, x2, z2 = found.floor.bounds
    # Angles below 1e-4 are left as they are.
    np.testing.assert_allclose(sorted((x2 - x1, z2 - z1)), (4, 6), atol=1e-3)
    np.testing.assert_allclose((x1 + x2, z1 + z2), 0, atol=1e-6)
    # The bed is square to the walls, at its distance from the centre.
    lower, upper = extent(found.furniture[0])
    np.testing.assert_allclose(sorted((upper - lower)[[0, 2]]), (1.8, 2.0), atol=1e-3)
    off = np.linalg.norm((lower + upper)[[0, 2]] / 2)
    assert off == pytest.approx(math.hypot(x, z + 1), abs=1e-5)


def test_a_crack_is_closed_without_a_spike_at_a_sliver():
    """A sliver's tip was drawn out where cracks are closed, and moved the room's origin."""

    def flat(*outline):
        corners = np.array([(x, 0.0, z) for x, z in outline])
        faces = [(0, k, k + 1) for k in range(1, len(corners) - 1)]
        return corners[np.array(faces)]

    rooms = [
        flat((0, 0), (4, 0), (4, 3), (0, 3)),
        flat((0, 3.02), (4, 3.02), (4, 5), (0, 5)),  # 2 cm from the other
    ]
    slivers = [
        flat((3.88346, 2.41731), (3.89420, 2.42116), (4.01034, 2.06384)),
        flat((4.02717, 4.79289), (4.02589, 4.79217), (3.90711, 5.00579)),
    ]
    for pieces in (rooms, [*rooms, slivers[0]], [*rooms, slivers[1]]):
        floor, _ = floor_of(pieces)
        points = np.concatenate(pieces)[..., [0, 2]].reshape(-1, 2)
        np.testing.assert_allclose(
            floor.bounds, [*points.min(axis=0), *points.max(axis=0)], rtol=0, atol=1e-4
        )  # what simplifying the outline may move
        assert floor.geom_type == "Polygon" and not floor.interiors
        assert abs(floor.area - 20) < 0.02


@pytest.mark.parametrize(
    ("name", "content"),
    {
        "truncated": b'{"scene": {"room"',
        "no text": b'{"mesh": "\xff\xfe"}',
        "a list": b"[]",
        "without rooms": b'{"furniture": [], "mesh": [], "scene": 1}',
        "gone": None,
    }.items(),
)
def test_files_that_are_no_houses(front, name, content):
    front.house("good", bedroom("A"))
    path = front.front / "bad.json"
    if content is not None:
        path.write_bytes(content)
    with refused(f"front/house that is {name}", tmp=front.root):
        read(front, path)
    path.write_bytes(b"[" * 100_000)
    with pytest.raises(InputError, match=r"bad.json is not JSON \(maximum recursion"):
        read(front, path)


def test_wrong_folders(front, tmp_path):
    (tmp_path / "empty").mkdir()
    for name, folder in (("missing", tmp_path / "missing"), ("models", front.future),
                         ("empty", tmp_path / "empty")):  # fmt: skip
        with refused(f"front/folder {name} for houses", tmp=tmp_path):
            house_files(folder)
    front.house("house", bedroom("A"))
    with refused("front/folder above for houses", tmp=tmp_path):
        house_files(front.root)


def test_houses_made_by_others():
    folder = shared_front()
    models = ModelBank(folder / "3D-FUTURE-model")
    house = folder / "3D-FRONT" / "0022c821-c1f2-516e-8552-8f01efccfc26.json"
    result = read_house(house, models, load_recipe("bedroom"), lambda _, kind: "Bedroom" in kind)
    hold("houses", {"a house made by others": described(result)}, slack=1e-5)
    # As in the picture that came with the data: head at the wall on the left, front to +x.
    bed = next(p for p in result.rooms[0].furniture if p.label == "double_bed")
    assert bed.yaw_rad == pytest.approx(math.pi / 2, abs=1e-3)
