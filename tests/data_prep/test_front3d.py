"""The reader against hand-computed rooms, one test a quirk of the real files."""

import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
from front_files import bedroom, room, surface

from data_prep.front3d import ModelBank, house_files, read_house, read_obj
from data_prep.recipe import category_classes, load_recipe
from sceneprior.classes import label_set
from sceneprior.errors import InputError

CLASSES = category_classes("bedroom_class")


def read(front, path, **options):
    return read_house(path, ModelBank(front.future), CLASSES, **options)


def only_room(front, path):
    result = read(front, path)
    assert not result.failures and len(result.rooms) == 1, result
    return result.rooms[0]


def extent(piece):
    vertices = piece.mesh.vertices_m
    return vertices.min(axis=0), vertices.max(axis=0)


def signed_volume(mesh):
    a, b, c = np.moveaxis(mesh.vertices_m[mesh.faces], 1, 0)
    return float((a * np.cross(b, c)).sum() / 6)


def test_a_plain_room_by_hand(front):
    path = front.house("house", bedroom("Bedroom-7", bounds=(1.0, 2.0, 5.0, 8.0), floor_y=0.5))
    room = only_room(front, path)
    assert room.room_id == "house_Bedroom-7" and room.type == "Bedroom"
    assert room.floor.bounds == (-2.0, -3.0, 2.0, 3.0)
    assert room.height_m == pytest.approx(2.6)
    assert [piece.label for piece in room.furniture] == [
        "double_bed", "nightstand", "nightstand", "void",
    ]  # fmt: skip
    assert room.furniture[0].category == "king-size bed"
    # The floor's centre (3, 0.5, 5) is the origin; the bed stands at (0, 0, -1), below the floor.
    lower, upper = extent(room.furniture[0])
    np.testing.assert_allclose(lower, (-3.9, -0.5, -7.0), atol=1e-6)
    np.testing.assert_allclose(upper, (-2.1, 0.5, -5.0), atol=1e-6)
    # A nightstand of 0.5 x 0.4, turned by 90 degrees, is 0.4 wide and 0.5 deep, and faces +x.
    lower, upper = extent(room.furniture[2])
    np.testing.assert_allclose(upper - lower, (0.4, 0.6, 0.5), atol=1e-6)
    assert room.furniture[2].yaw_rad == pytest.approx(math.pi / 2)
    assert room.notes == ()


@pytest.mark.parametrize("degrees", [0, 17, 45 - 1e-3, 120, -75])
def test_walls_are_turned_along_the_axes(front, degrees):
    turned = bedroom("A", bounds=(-2.0, -3.0, 2.0, 3.0), yaw_rad=math.radians(degrees))
    room = only_room(front, front.house("house", turned))
    x1, z1, x2, z2 = room.floor.bounds
    sides = sorted((x2 - x1, z2 - z1))
    np.testing.assert_allclose(sides, (4, 6), atol=1e-9)
    np.testing.assert_allclose((x1 + x2, z1 + z2), 0, atol=1e-9)
    # The bed still stands 1 m from the centre, square to the walls.
    lower, upper = extent(room.furniture[0])
    np.testing.assert_allclose(sorted((upper - lower)[[0, 2]]), (1.8, 2.0), atol=1e-6)
    assert np.linalg.norm((lower + upper)[[0, 2]] / 2) == pytest.approx(1.0, abs=1e-6)


def test_quaternions_are_x_y_z_w(front):
    # 90 degrees about y is (0, s, 0, s): +z turns to +x.
    piece = {"jid": "bed", "pos": (0, 0, 0), "rot": [0, math.sqrt(0.5), 0, math.sqrt(0.5)]}
    room_ = only_room(front, front.house("house", room("A", [piece])))
    assert room_.furniture[0].yaw_rad == pytest.approx(math.pi / 2)
    # A quaternion that is not of unit length is still a turn, never a scale.
    long = {"jid": "bed", "pos": (0, 0, 0), "rot": [0, 3, 0, 3]}
    other = only_room(front, front.house("other", room("A", [long])))
    np.testing.assert_allclose(
        other.furniture[0].model_to_room, room_.furniture[0].model_to_room, atol=1e-12
    )


def test_mirrored_pieces_keep_their_outside_out(front):
    plain = {"jid": "bed", "pos": (0, 0, 0)}
    mirrored = {"jid": "bed", "pos": (0, 0, 0), "scale": [-1, 1, 1]}
    one, other = (
        only_room(front, front.house(name, room("A", [piece]))).furniture[0]
        for name, piece in (("one", plain), ("other", mirrored))
    )
    assert signed_volume(one.mesh) == pytest.approx(signed_volume(other.mesh))
    assert abs(signed_volume(one.mesh)) == pytest.approx(1.8 * 1.0 * 2.0, rel=1e-6)
    np.testing.assert_allclose(other.mesh.vertices_m[:, 0], -one.mesh.vertices_m[:, 0], atol=1e-6)
    assert other.yaw_rad == pytest.approx(one.yaw_rad)


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


def test_entries_without_valid_are_skipped(front):
    written = bedroom("A")
    del written["_furniture"][1]["valid"]
    assert len(only_room(front, front.house("house", written)).furniture) == 3


def test_duplicate_uids_and_duplicate_placements(front):
    written = bedroom("A")
    written["_furniture"].append(dict(written["_furniture"][0]))  # the same uid again
    assert len(only_room(front, front.house("house", written)).furniture) == 4
    twice = bedroom("A")
    twice["children"].append(dict(twice["children"][2]))  # the same piece at the same place
    room_ = only_room(front, front.house("twice", twice))
    assert len(room_.furniture) == 4
    assert room_.notes == ("bed stands twice at the same place; one is kept",)


def test_models_a_hundred_times_too_large(front):
    front.model("huge", "Wardrobe", (150.0, 220.0, 60.0))
    found = only_room(front, front.house("house", room("A", [{"jid": "huge", "pos": (0, 0, 0)}])))
    lower, upper = extent(found.furniture[0])
    np.testing.assert_allclose(upper - lower, (1.5, 2.2, 0.6), rtol=1e-6)
    # What the ground truth's matrix is applied to is already in metres.
    np.testing.assert_allclose(found.furniture[0].model_to_room, np.eye(4), atol=1e-12)


def test_missing_and_broken_models_are_named(front):
    front.list_model("ghost", "Desk")
    front.model("empty", "Desk", (1, 1, 1))
    (front.future / "empty" / "raw_model.obj").write_text("v 0 0 0\n")
    front.model("cut", "Desk", (1, 1, 1))
    (front.future / "cut" / "raw_model.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n")
    pieces = [{"jid": jid, "pos": (0, 0, 0)} for jid in ("bed", "ghost", "empty", "cut", "")]
    found = only_room(front, front.house("house", room("A", pieces)))
    assert [piece.model_id for piece in found.furniture] == ["bed"]
    assert "ghost is left out: the models folder has no raw_model.obj for it" in found.notes[0]
    assert "empty/raw_model.obj holds no usable triangles" in found.notes[1]
    assert "cut/raw_model.obj cannot be read" in found.notes[2]
    assert len(found.notes) == 4


def test_unknown_models_and_null_categories_are_void(front):
    front.model("null", None, (1, 1, 1))
    front.model("odd", "Space Ship", (1, 1, 1))
    pieces = [{"jid": "null", "pos": (0, 0, 0)}, {"jid": "odd", "pos": (1, 0, 0)}]
    found = only_room(front, front.house("house", room("A", pieces))).furniture
    assert [(piece.category, piece.label) for piece in found] == [
        ("others", "void"), ("space ship", "void"),
    ]  # fmt: skip


def test_categories_with_slashes():
    assert CLASSES["corner/side table"] == "table"
    assert set(CLASSES.values()) <= set(label_set("front3d_bedroom"))
    assert set(category_classes("living_room_class").values()) == set(label_set("front3d_living"))


def test_several_floors_are_one(front):
    written = bedroom("A", bounds=(-2.0, -2.0, 0.0, 2.0))
    # The second piece of floor begins after a door sill of 3 cm.
    corners = [(0.03, 0, -2), (2, 0, -2), (2, 0, 2), (0.03, 0, 2)]
    written["_meshes"].append(surface("floor2", "Floor", corners))
    written["children"].append({"ref": "floor2"})
    floor = only_room(front, front.house("house", written)).floor
    assert floor.geom_type == "Polygon"
    np.testing.assert_allclose(floor.bounds, (-2, -2, 2, 2), atol=1e-9)
    assert floor.area == pytest.approx(16, abs=1e-6)


def test_walls_may_be_missing(front):
    written = bedroom("A")
    written["children"] = [c for c in written["children"] if c["ref"] != "wall-A"]
    assert only_room(front, front.house("bare", dict(written))).height_m == 2.8  # the usual height
    written = bedroom("A")
    written["_meshes"][1] = surface(
        "wall-A", "Ceiling", [(0, 3.1, 0), (1, 3.1, 0), (1, 3.1, 1), (0, 3.1, 1)]
    )
    assert only_room(front, front.house("ceiling", written)).height_m == pytest.approx(3.1)


def test_meshes_without_faces_or_type(front):
    written = bedroom("A")
    written["_meshes"] += [
        {"uid": "hollow", "type": "Floor", "xyz": [0, 0, 0], "faces": []},
        {"uid": "typeless", "type": "", "xyz": [0, 0, 0], "faces": [0, 0, 0]},
        {"uid": "wild", "type": "WallInner", "xyz": [0, 9, 0], "faces": [0, 0, 7]},
    ]
    written["children"] += [{"ref": "hollow"}, {"ref": "typeless"}, {"ref": "wild"}]
    room_ = only_room(front, front.house("house", written))
    assert room_.floor.area == pytest.approx(16) and room_.height_m == pytest.approx(2.6)


def test_a_room_without_floor_fails_by_name(front):
    bad = bedroom("Bad")
    bad["children"] = bad["children"][1:]
    result = read(front, front.house("house", bad, bedroom("Good")))
    assert [room_.room_id for room_ in result.rooms] == ["house_Good"]
    assert result.failures == [("house_Bad", "it has no floor")]


@pytest.mark.parametrize(
    ("key", "value", "note"),
    [
        ("pos", [0, float("nan"), 0], "no places"),
        ("rot", [0, 0, 0, 0], "incomplete"),
        ("rot", [0, 1], "not enough values"),
        ("scale", [1, 1], "incomplete"),
        ("pos", "here", "could not convert"),
    ],
)
def test_placements_that_are_no_numbers_are_named(front, key, value, note):
    written = bedroom("A")
    written["children"][2][key] = value
    room_ = only_room(front, front.house("house", written))
    assert len(room_.furniture) == 3
    assert "bed is left out" in room_.notes[0] and note in room_.notes[0]


def test_wild_scales_leave_the_room_out(front):
    written = room("A", [{"jid": "bed", "pos": (0, 0, 0), "scale": [1, 6, 1]}])
    result = read(front, front.house("house", written), scale_range=(1e-5, 5.0))
    assert not result.rooms
    assert result.filtered == [("house_A", "bed is scaled by 1, 6, 1, beyond scale_range")]


def test_two_rooms_of_one_name(front):
    result = read(front, front.house("house", bedroom("A"), bedroom("A")))
    assert len(result.rooms) == 1 and "same instanceid" in result.failures[0][1]


@pytest.mark.parametrize(
    "text",
    ['{"scene": {"room"', "[]", '{"scene": {}}', '{"furniture": 3, "mesh": [], "scene": 1}', ""],
)
def test_files_that_are_no_houses(front, text):
    front.house("good", bedroom("A"))
    path = front.front / "bad.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"bad\.json is not"):
        read(front, path)


def test_mutilated_houses_never_raise_a_traceback(front, numbers):
    """Replace one value after the other by something else: rooms come, or named failures."""
    source = front.house("house", bedroom("A"), bedroom("B"))
    text = source.read_text()
    for _ in range(300):
        data = json.loads(text)
        place = data
        while True:  # walk to a random leaf or branch
            keys = list(place) if isinstance(place, dict) else range(len(place))
            key = keys[numbers.integers(len(keys))]
            inner = place[key]
            if not isinstance(inner, (dict, list)) or not inner or numbers.random() < 0.2:
                break
            place = inner
        junk = [None, "x", -1, 1e300, float("nan"), [], {}, [None], True, "1e999"]
        place[key] = junk[numbers.integers(len(junk))]
        source.write_text(json.dumps(data))
        try:
            result = read(front, source, scale_range=(1e-5, 5.0))
        except InputError as error:
            assert "house.json" in str(error)
            continue
        for room_ in result.rooms:
            assert np.isfinite(room_.floor.bounds).all()
            for piece in room_.furniture:
                assert np.isfinite(piece.mesh.vertices_m).all()


def test_wrong_folders(front, tmp_path):
    with pytest.raises(InputError, match=r"No folder at .*--front names"):
        house_files(tmp_path / "missing")
    with pytest.raises(InputError, match=r"holds furniture models, not houses"):
        house_files(front.future)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"holds no house JSONs \(<uid>\.json\)\."):
        house_files(tmp_path / "empty")
    front.house("house", bedroom("A"))
    with pytest.raises(InputError, match=r"did you mean .*3D-FRONT"):
        house_files(front.root)
    with pytest.raises(InputError, match=r"No folder at .*--future names"):
        ModelBank(tmp_path / "missing")
    with pytest.raises(InputError, match=r"has no model_info\.json"):
        ModelBank(front.front)
    (front.future / "model_info.json").write_text('{"a": 1}')
    with pytest.raises(InputError, match="is not 3D-FUTURE's list of models"):
        ModelBank(front.future)


def test_obj_corner_styles(tmp_path):
    path = tmp_path / "model" / "raw_model.obj"
    path.parent.mkdir()
    path.write_text(
        "# c\nv 0 0 0 1.0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\ng a\n"
        "f 1//1 2//1 3//1 4//1\nf -4 -3 -2\n"
    )
    mesh = read_obj(path)
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]]
    assert mesh.vertices_m.dtype == np.float32 and mesh.faces.dtype == np.int32


def test_recipes_load_and_say_what_is_wrong():
    recipe = load_recipe("front3d_bedroom", ("max_floor_m=null", "views.per_m2=3"))
    assert recipe.max_floor_m is None and recipe.views.per_m2 == 3
    assert recipe.of_type("MasterBedroom") and not recipe.of_type("LivingRoom")
    assert load_recipe("front3d_living").of_type("LivingDiningRoom")
    with pytest.raises(InputError, match="No recipe is called 'front3d_attic'; there are front3d"):
        load_recipe("front3d_attic")
    with pytest.raises(InputError, match=r"front3d_bedroom\.yaml has no rule 'max_flor_m'"):
        load_recipe("front3d_bedroom", ("max_flor_m=3",))
    with pytest.raises(InputError, match="'max_floor_m' is not a rule"):
        load_recipe("front3d_bedroom", ("max_floor_m",))


def shared_front() -> Path:
    folder = Path(os.environ.get("SCENEPRIOR_SHARED", Path(__file__).parents[3] / "shared"))
    folder = folder / "data" / "front"
    if not folder.is_dir():
        pytest.skip("no shared data beside the repository")
    return folder


def test_houses_made_by_others():
    folder = shared_front()
    models = ModelBank(folder / "3D-FUTURE-model")
    house = folder / "3D-FRONT" / "0022c821-c1f2-516e-8552-8f01efccfc26.json"
    result = read_house(house, models, CLASSES, lambda _, kind: "Bedroom" in kind)
    assert not result.failures and len(result.rooms) == 1
    room_ = result.rooms[0]
    np.testing.assert_allclose(room_.floor.bounds, (-2.4145, -2.4145, 2.4145, 2.4145), atol=1e-9)
    assert room_.height_m == pytest.approx(2.7)
    assert room_.floor_outline_m.shape == (6, 2)  # an L
    assert sorted(piece.label for piece in room_.furniture) == [
        "armchair", "cabinet", "ceiling_lamp", "double_bed", "void",
    ]  # fmt: skip
    bed = next(piece for piece in room_.furniture if piece.label == "double_bed")
    # As in the picture that came with the data: head at the wall on the left, front to +x.
    assert bed.yaw_rad == pytest.approx(math.pi / 2, abs=1e-3)
    lower, upper = extent(bed)
    np.testing.assert_allclose((lower[0], upper[0], lower[1]), (-2.39, -0.15, 0), atol=0.03)
