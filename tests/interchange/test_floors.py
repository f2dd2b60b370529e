"""Floors from files: our own scenes, ATISS's boxes and 3D-FRONT's houses give the same outline, and
rooms of Structured3D have their doors and windows."""

import json
import math
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


def _room_that_is_none(folder: Path) -> str:
    return f"{written(folder, 'threed-front')}:Kitchen-1"


def _bare_scene(folder: Path) -> str:
    save(Scene("bare", "front3d_bedroom"), folder / "bare.json")
    return f"{folder}/bare.json"


def _house_with(*corner_m: float):
    """A house whose floor is one triangle: two short sides, to the given corner."""

    def write(folder: Path) -> str:
        mesh = {"uid": "a", "type": "Floor", "faces": [0, 1, 2]}
        mesh["xyz"] = [0, 0, 0, *corner_m, 1e-9, 0, 0]
        room = {"instanceid": "Bedroom-0", "children": [{"ref": "a"}]}
        house = {"scene": {"room": [room]}, "mesh": [mesh]}
        (folder / "room.json").write_text(json.dumps(house))
        return f"{folder}/room.json"

    return write


def _boxes_without_floor(folder: Path) -> str:
    np.savez(folder / "boxes.npz", sizes=np.zeros((0, 3)))
    return f"{folder}/boxes.npz"


def _text(content: str, name: str = "floor.json"):
    def write(folder: Path) -> str:
        (folder / name).write_text(content)
        return f"{folder}/{name}"

    return write


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (_text("{}"), "is no floor; expected a list of corners"),
        (_text("[[0, 0], [1, 1]]"), "lists no floor; expected at least 3 corners"),
        (_text("[[0, 0], [400, 0], [400, 300]]"), "Are these centimetres"),
        (_text('{"scene": 1, "mesh": []}'), "is no house of 3D-FRONT"),
        (_text("no archive", "broken.npz"), "cannot be read"),
        (_bare_scene, "a scene without a floor; give one with floor_m"),
        (_boxes_without_floor, "has no floor; expected floor_plan_vertices"),
        (
            _room_that_is_none,
            r"room\.json has the rooms Bedroom-0; name one of them as room\.json:",
        ),
        (_house_with(math.nan, 0, 1), "no house of 3D-FRONT .*xyz of a floor is not finite"),
        (_house_with(math.inf, 0, 1), "no house of 3D-FRONT .*xyz of a floor is not finite"),
        (_house_with(10**400, 0, 1), "no house of 3D-FRONT .OverflowError"),
        (_house_with(0, 0, 1e-9), "room Bedroom-0 has no floor"),
        (_text('{"scene": {"room": []}, "mesh": []}'), "has the rooms none; name one"),
    ],
)
def test_what_has_no_floor_is_a_sentence(write, message, tmp_path):
    with pytest.raises(InputError, match=message):
        read_floor_file(write(tmp_path))


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


@pytest.mark.parametrize("wrong", ["", "7", "kitchen", "2", "outwall"])
def test_the_rooms_of_a_house_of_structured3d_are_listed(tmp_path, wrong):
    listed = r"has the rooms 0 \(bedroom\), 1 \(corridor\); name one of them as annotation_3d\."
    with pytest.raises(InputError, match=listed):
        structured3d(tmp_path, wrong)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("junctions", [{"coordinate": [0, 0]}], "is no annotation_3d.json of Structured3D"),
        ("junctions", made_house()["junctions"][:-1], "junctions, but matrices of"),
        ("planes", [3], "TypeError"),
        ("semantics", [], "has the rooms none"),
        ("semantics", [{"type": "bedroom"}], "KeyError: 'planeID'"),
        ("semantics", [{"type": "bedroom", "planeID": [999]}], r"planeID \[999\]"),
        ("planeLineMatrix", [[0] * 3, [0]], "is no annotation_3d.json of Structured3D"),
        ("planeLineMatrix", [[0] * len(row) for row in made_house()["planeLineMatrix"]],
         "the lines of the floor of room 0 enclose no area"),
    ],
)  # fmt: skip
def test_damaged_houses_of_structured3d_are_sentences(tmp_path, key, value, message):
    with pytest.raises(InputError, match=message):
        structured3d(tmp_path, "0", made_house() | {key: value})
