"""Floors from files: our own scenes, ATISS's boxes and 3D-FRONT's houses give the same outline."""

import json
from pathlib import Path

import numpy as np
import pytest
import shapely

from sceneprior.core.errors import InputError
from sceneprior.core.scene import Opening, Scene, SceneObject
from sceneprior.interchange.export import export_scenes
from sceneprior.interchange.floors import read_floor_file

L_SHAPE = np.array([[-2, -2], [2, -2], [2, 1], [0, 1], [0, 2], [-2, 2]], dtype=float)
DOOR = Opening("door", (-0.5, -2.0), (0.4, -2.0), 0.0, 2.0)
ROOM = Scene(
    "room", "front3d_bedroom", (SceneObject("desk", (0.0, 0.4, 0.0), (1.0, 0.8, 0.5)),), L_SHAPE,
    openings=(DOOR,), ceiling_m=2.5,
)  # fmt: skip


def written(folder: Path, to: str) -> str:
    if to == "scene":
        ROOM.save(folder / "room.json")
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
    Scene("bare", "front3d_bedroom").save(tmp_path / "bare.json")
    with pytest.raises(InputError, match="a scene without a floor; give one with floor_m"):
        read_floor_file(f"{tmp_path}/bare.json")


def test_boxes_without_a_floor_are_a_sentence(tmp_path):
    np.savez(tmp_path / "boxes.npz", sizes=np.zeros((0, 3)))
    with pytest.raises(InputError, match="has no floor; expected floor_plan_vertices"):
        read_floor_file(f"{tmp_path}/boxes.npz")
    (tmp_path / "broken.npz").write_text("no archive")
    with pytest.raises(InputError, match="cannot be read"):
        read_floor_file(f"{tmp_path}/broken.npz")
