"""Floors from files: our own scenes, ATISS's boxes and 3D-FRONT's houses give the same outline, and
rooms of Structured3D have their doors and windows."""

import json
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
import shapely
from structured3d_house import BEDROOM_MM, CORRIDOR_MM, made_house

from sceneprior.core.errors import InputError
from sceneprior.core.scene import Opening, Scene, SceneObject
from sceneprior.interchange.export import export_scenes
from sceneprior.interchange.floors import FloorPlan, read_floor_file
from sceneprior.lifted.requests.floors import Floor
from sceneprior.lifted.requests.openings import place_openings
from sceneprior.render.scene_files import save

L_SHAPE = np.array([[-2, -2], [2, -2], [2, 1], [0, 1], [0, 2], [-2, 2]], dtype=float)
DOOR = Opening("door", (-0.5, -2.0), (0.4, -2.0), 0.0, 2.0)
ROOM = Scene(
    "room", "front3d_bedroom", (SceneObject("desk", (0.0, 0.4, 0.0), (1.0, 0.8, 0.5)),), L_SHAPE,
    openings=(DOOR,), ceiling_m=2.5,
)  # fmt: skip


def written(folder: Path, to: str) -> str:
    if to == "scene":
        save(ROOM, folder / "room.json")
        return f"{folder}/room.json"
    if to == "polygon":
        (folder / "floor.json").write_text(json.dumps(L_SHAPE.tolist()))
        return f"{folder}/floor.json"
    export_scenes([ROOM], to, folder)
    return f"{folder}/room/boxes.npz" if to == "atiss" else f"{folder}/3D-FRONT/room.json"


@pytest.mark.parametrize("to", ["scene", "polygon", "atiss", "threed-front"])
def test_every_file_gives_the_outline(to, tmp_path):
    found = read_floor_file(written(tmp_path, to))
    off = shapely.Polygon(found.outline_m).symmetric_difference(shapely.Polygon(L_SHAPE))
    assert off.area < 1e-4 and len(found.outline_m) == 6
    assert found.openings == ((DOOR,) if to == "scene" else ())
    assert found.ceiling_m == (2.5 if to == "scene" else None)


def test_a_room_of_a_house_is_named(tmp_path):
    name = written(tmp_path, "threed-front")
    assert len(read_floor_file(f"{name}:Bedroom-0").outline_m) == 6
    with pytest.raises(InputError, match=r"the rooms Bedroom-0; name one of them as room\.json:"):
        read_floor_file(f"{name}:Kitchen-1")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{}", "is no floor; expected a list of corners"),
        ("[[0, 0], [1, 1]]", "lists no floor; expected at least 3 corners"),
        ("[[0, 0], [400, 0], [400, 300]]", "Are these centimetres"),
        ('{"scene": 1, "mesh": []}', "is no house of 3D-FRONT"),
    ],
)
def test_what_has_no_floor_is_a_sentence(text, message, tmp_path):
    (tmp_path / "floor.json").write_text(text)
    with pytest.raises(InputError, match=message):
        read_floor_file(f"{tmp_path}/floor.json")


def test_a_scene_without_a_floor_is_a_sentence(tmp_path):
    save(Scene("bare", "front3d_bedroom"), tmp_path / "bare.json")
    with pytest.raises(InputError, match="a scene without a floor; give one with floor_m"):
        read_floor_file(f"{tmp_path}/bare.json")


def test_boxes_without_a_floor_are_a_sentence(tmp_path):
    np.savez(tmp_path / "boxes.npz", sizes=np.zeros((0, 3)))
    with pytest.raises(InputError, match="has no floor; expected floor_plan_vertices"):
        read_floor_file(f"{tmp_path}/boxes.npz")
    (tmp_path / "broken.npz").write_text("no archive")
    with pytest.raises(InputError, match="cannot be read"):
        read_floor_file(f"{tmp_path}/broken.npz")


def structured3d(folder: Path, room: str, house: dict | None = None) -> FloorPlan:
    (folder / "annotation_3d.json").write_text(json.dumps(house or made_house()))
    return read_floor_file(f"{folder}/annotation_3d.json:{room}")


def outline_of(corners_mm: list[tuple[int, int]]) -> shapely.Polygon:
    return shapely.Polygon([(x / 1000, -y / 1000) for x, y in corners_mm])


@pytest.mark.parametrize("room", ["0", "bedroom"])
def test_a_room_of_structured3d_has_its_door_and_its_window(room, tmp_path):
    found = structured3d(tmp_path, room)
    off = shapely.Polygon(found.outline_m).symmetric_difference(outline_of(BEDROOM_MM))
    assert off.area < 1e-9 and len(found.outline_m) == 6
    assert found.ceiling_m == pytest.approx(2.8)
    assert [each.kind for each in found.openings] == ["door", "window"]
    door, window = (np.sort([each.start_m, each.end_m], axis=0) for each in found.openings)
    assert np.allclose(door, [(4, -1.4), (4, -0.5)], atol=1e-9)
    assert np.allclose(window, [(0.6, -5), (1.5, -5)], atol=1e-9)
    heights = [(each.bottom_m, each.top_m) for each in found.openings]
    assert np.allclose(heights, [(0, 2.1), (0.9, 2.3)], atol=1e-9)
    assert place_openings(Floor(found.outline_m), found.openings, np.random.default_rng(0))


def test_the_door_is_in_the_wall_of_the_other_room_too_and_columns_are_filled(tmp_path):
    found = structured3d(tmp_path, "1")
    off = shapely.Polygon(found.outline_m).symmetric_difference(outline_of(CORRIDOR_MM))
    assert off.area < 1e-9 and len(found.outline_m) == 4
    (door,) = found.openings
    ends = np.sort([door.start_m, door.end_m], axis=0)
    assert np.allclose(ends, [(4.12, -1.4), (4.12, -0.5)], atol=1e-9)


def test_a_house_of_structured3d_is_moved_and_raised(tmp_path):
    house = made_house()
    for junction in house["junctions"]:
        junction["coordinate"] = np.add(junction["coordinate"], [7000, -3000, 500]).tolist()
    found, plain = structured3d(tmp_path, "0", house), structured3d(tmp_path, "0")
    assert np.allclose(found.outline_m - plain.outline_m, [7, 3], atol=1e-9)
    assert np.allclose([o[3:] for o in found.openings], [o[3:] for o in plain.openings])


def test_corners_of_doors_are_no_corners_of_the_floor(tmp_path):
    """The line of a floor at a wall is divided where a door is."""
    house = made_house()
    lines = house["lineJunctionMatrix"]
    at = [row["coordinate"] for row in house["junctions"]]
    side = [at.index([4000.0, y, 0.0]) for y in (0.0, 500.0, 1400.0, 3000.0)]
    for first, last in ((0, 1), (2, 3)):
        row = [int(k in (side[first], side[last])) for k in range(len(at))]
        lines.append(row)
        house["lines"].append({"ID": len(lines) - 1, "point": at[side[0]], "direction": [0, 1, 0]})
    whole = lines.index([int(k in (side[0], side[3])) for k in range(len(at))])
    door = lines.index([int(k in (side[1], side[2])) for k in range(len(at))])
    for plane, row in enumerate(house["planeLineMatrix"]):
        row += [int(plane == 0)] * 2
    house["planeLineMatrix"][0][whole], house["planeLineMatrix"][0][door] = 0, 1
    found = structured3d(tmp_path, "0", house)
    assert len(found.outline_m) == 6 and len(found.openings) == 2


def test_the_rooms_of_a_house_of_structured3d_are_listed(tmp_path):
    listed = (
        r"has the rooms 0 \(bedroom\), 1 \(corridor\); name one of them as annotation_3d\.json:"
    )
    for wrong in ("", "7", "kitchen", "2", "outwall"):
        with pytest.raises(InputError, match=listed):
            structured3d(tmp_path, wrong)
    house = made_house()
    house["semantics"][1]["type"] = "bedroom"
    with pytest.raises(InputError, match=r"has the rooms 0 \(bedroom\), 1 \(bedroom\)"):
        structured3d(tmp_path, "bedroom", house)
    house["semantics"] = []
    with pytest.raises(InputError, match="has the rooms none"):
        structured3d(tmp_path, "0", house)


def test_damaged_houses_of_structured3d_are_sentences(tmp_path):
    def damaged(key: str, value: object, message: str) -> None:
        house = deepcopy(made_house())
        house[key] = value
        with pytest.raises(InputError, match=message):
            structured3d(tmp_path, "0", house)

    whole = made_house()
    damaged("junctions", [{"coordinate": [0, 0]}], "is no annotation_3d.json of Structured3D")
    damaged("junctions", whole["junctions"][:-1], "junctions, but matrices of")
    damaged("planes", [3], "TypeError")
    damaged("semantics", [{"type": "bedroom"}], "KeyError: 'planeID'")
    damaged("semantics", [{"type": "bedroom", "planeID": [999]}], r"planeID \[999\]")
    damaged("planeLineMatrix", [[0] * 3, [0]], "is no annotation_3d.json of Structured3D")
    nothing = [[0] * len(row) for row in whole["planeLineMatrix"]]
    damaged("planeLineMatrix", nothing, "the lines of the floor of room 0 enclose no area")
    (tmp_path / "cut.json").write_text(json.dumps(whole)[:5000])
    with pytest.raises(InputError, match="it may be truncated"):
        read_floor_file(f"{tmp_path}/cut.json:0")
