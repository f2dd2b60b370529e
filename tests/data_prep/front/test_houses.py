"""The entries of a house file, one test a quirk of the real ones."""

import json

import numpy as np
import pytest
from front_files import bedroom, room
from front_reading import extent, only_room, read

from sceneprior.core.errors import InputError


def test_both_flavours_of_entries_and_keys(front):
    pieces = [
        {"jid": "bed", "pos": (0, 0, 0), "entry": {"category": "?", "bbox": [9, 9, 9]}},
        {"jid": "stand", "pos": (1.5, 0, 0),
         "entry": {"sourceCategoryId": "x", "title": "y", "size": [9, 9, 9]}},
    ]  # fmt: skip
    found = only_room(front, front.house("house", room("A", pieces))).furniture
    assert [piece.label for piece in found] == ["double_bed", "nightstand"]


def test_strings_instead_of_numbers(front):
    written = bedroom("A")
    for mesh in written["_meshes"]:
        mesh["xyz"] = [str(value) for value in mesh["xyz"]]
        mesh["faces"] = [str(value) for value in mesh["faces"]]
    written["children"][2]["pos"] = ["0.0", "0", "-1.0"]
    room_ = only_room(front, front.house("house", written))
    assert room_.floor.bounds == (-2.0, -2.0, 2.0, 2.0)
    np.testing.assert_allclose(extent(room_.furniture[0])[0], (-0.9, 0, -2.0), atol=1e-6)
    whole = bedroom("A")
    for mesh in whole["_meshes"]:
        mesh["xyz"] = ",".join(str(value) for value in mesh["xyz"])
    assert only_room(front, front.house("other", whole)).floor.area == pytest.approx(16)


def test_dangling_references_are_nothing(front):
    written = bedroom("A")
    written["children"] += [{"ref": "nowhere", "pos": [0, 0, 0]}, {"ref": None}, {}, "junk"]
    assert len(only_room(front, front.house("house", written)).furniture) == 4


@pytest.mark.parametrize("valid", [False, None, "false", 0])
def test_entries_that_are_not_valid_are_skipped(front, valid):
    pieces = [
        {"jid": "bed", "pos": (0, 0, 0)},
        {"jid": "stand", "pos": (1.5, 0, 0), "entry": {"valid": valid}},
    ]
    assert len(only_room(front, front.house("house", room("A", pieces))).furniture) == 1


def test_duplicate_uids_and_duplicate_placements(front):
    written = bedroom("A")
    written["_furniture"].append(dict(written["_furniture"][0]))  # the same uid again
    assert len(only_room(front, front.house("house", written)).furniture) == 4
    twice = bedroom("A")
    twice["children"].append(dict(twice["children"][2]))  # the same piece at the same place
    room_ = only_room(front, front.house("twice", twice))
    assert len(room_.furniture) == 4
    assert room_.notes == ("'bed' stands twice at the same place; one is kept",)


def test_a_room_without_floor_is_left_out_and_with_a_damaged_one_fails(front):
    bare, bad = bedroom("OtherRoom-1"), bedroom("Bad")
    bare["children"] = bare["children"][1:]
    bad["_meshes"][0]["xyz"] = [0.0] * 12
    result = read(front, front.house("house", bare, bad, bedroom("Good")))
    assert [room_.room_id for room_ in result.rooms] == ["house_Good"]
    assert result.filtered == [("house_OtherRoom-1", "no_floor", "no floor belongs to it")]
    assert result.failures == [("house_Bad", "it has no floor")]


@pytest.mark.parametrize(
    ("key", "value", "note"),
    [
        ("pos", [0, float("nan"), 0], "implausible numbers"),
        ("rot", [0, 0, 0, 0], "incomplete"),
        ("scale", [1, 1], "incomplete"),
        ("scale", {}, "expected a list of numbers"),
        ("pos", "here", "holds something else"),
        ("pos", None, "its placement has no pos"),
    ],
)
def test_placements_that_are_no_numbers_are_named(front, key, value, note):
    written = bedroom("A")
    written["children"][2][key] = value
    room_ = only_room(front, front.house("house", written))
    assert len(room_.furniture) == 3
    assert "'bed' is left out" in room_.notes[0] and note in room_.notes[0]


def test_a_scale_of_zero_is_never_drawn(front):
    pieces = [
        {"jid": "bed", "pos": (0, 0, 0)},
        {"jid": "stand", "pos": (1, 0, 0), "scale": [1, 0, 1]},
    ]
    path = front.house("house", room("A", pieces))
    assert read(front, path).filtered[0][1] == "scale_range"
    room_ = only_room(front, path, rules=("scale_range=null",))
    assert [piece.model_id for piece in room_.furniture] == ["bed"]
    assert room_.notes == ("'stand' is left out: it is scaled by 1, 0, 1, to nothing",)


def test_mirrored_pieces_can_be_ruled_out(front):
    pieces = [{"jid": "bed", "pos": (0, 0, 0), "scale": [-1, 1, 1]}]
    path = front.house("house", room("A", pieces))
    assert len(read(front, path).rooms) == 1
    filtered = read(front, path, rules=("allow_mirrored=false",)).filtered
    assert filtered == [("house_A", "allow_mirrored", "'bed' is mirrored, scaled by -1, 1, 1")]


def test_rooms_without_furniture_are_filtered_not_failed(front):
    bare = room("Bare", [])
    no_floor = room("Hole", [])
    no_floor["children"] = []
    rejected = room("Odd", [{"jid": "bed", "pos": (0, 0, 0), "entry": {"valid": False}}])
    result = read(front, front.house("house", bare, no_floor, rejected))
    assert not result.rooms and not result.failures
    assert result.filtered == [
        (f"house_{name}", "no_furniture", "no furniture stands in it")
        for name in ("Bare", "Hole", "Odd")
    ]


def test_ids_that_are_no_names(front):
    """Ids become parts of paths and lines of reports, so they cannot be just anything."""
    rooms = [bedroom(name) for name in ("../../up", "a\nb", "x" * 300, "\ud800", "good")]
    path = front.house("house", *rooms)
    result = read(front, path)
    assert [item.room_id for item in result.rooms] == ["house_good"]
    assert [room_id for room_id, _ in result.failures] == [f"house_room{k}" for k in range(4)]
    assert all("is not a valid name" in why and why.isprintable() for _, why in result.failures)
    pieces = [
        {"jid": jid, "pos": (0, 0, 0)} for jid in ("bed", "../bed", "\ud800", "\0", "y" * 999)
    ]
    room_ = only_room(front, front.house("other", room("A", pieces)))
    assert [piece.model_id for piece in room_.furniture] == ["bed"]
    assert len(room_.notes) == 4
    assert all(note.isprintable() and len(note) < 200 for note in room_.notes)


def test_entries_that_are_no_objects(front):
    path = front.house("house", bedroom("A"))
    data = json.loads(path.read_text())
    data["furniture"] += [None, 7, "x", {"uid": None}, {"uid": ["a"]}]
    data["mesh"] += [None, [], {"uid": {}}]
    data["scene"]["room"] += [3, {"type": "Bedroom", "instanceid": "B", "children": {"ref": 1}}]
    path.write_text(json.dumps(data))
    result = read(front, path)
    assert [len(item.furniture) for item in result.rooms] == [4]
    assert result.failures == [
        ("house_room1", "its entry is no JSON object"),
        ("house_B", "its children are not a list"),
    ]


def test_two_rooms_of_one_name(front):
    result = read(front, front.house("house", bedroom("A"), bedroom("A")))
    assert len(result.rooms) == 1 and "same instanceid" in result.failures[0][1]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b'{"scene": {"room"', "is not JSON .*; it may be truncated"),
        (b"[" * 100_000, "is not JSON"),
        (b'{"mesh": "\xff\xfe"}', "is not JSON .*utf-8"),
        (b"[]", "is not a 3D-FRONT house: it has no list 'furniture'"),
        (b'{"furniture": [], "mesh": [], "scene": 1}', ".* has no list 'scene.room'"),
    ],
)
def test_files_that_are_no_houses(front, content, said):
    front.house("good", bedroom("A"))
    path = front.front / "bad.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"^bad\.json {said}"):
        read(front, path)


def test_a_file_that_cannot_be_read(front, tmp_path):
    front.house("good", bedroom("A"))
    with pytest.raises(InputError, match=r"gone\.json cannot be read \(No such file"):
        read(front, front.front / "gone.json")
