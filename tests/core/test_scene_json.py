"""Floors, doors and windows in a scene's JSON."""

import json

import numpy as np
import pytest

from sceneprior.core.errors import InputError
from sceneprior.core.scene import Opening, Scene, SceneObject, Solid
from sceneprior.core.scene_json import read_scene, scene_to_json

FLOOR = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [2.0, 3.0], [2.0, 2.0], [0.0, 2.0]])
DOOR = Opening("door", (4.0, 1.0), (4.0, 1.9), 0.0, 2.0)


def written(tmp_path, *openings, floor=FLOOR, **more):
    path = tmp_path / "room.json"
    scene = Scene("room", "front3d_bedroom", (), floor, openings=openings, **more)
    path.write_text(json.dumps(scene_to_json(scene)))
    return path


def test_openings_and_ceiling_come_back(tmp_path):
    window = Opening("window", (2.0, 2.2), (2.0, 2.8), 0.9, 2.1)
    scene = read_scene(written(tmp_path, DOOR, window, ceiling_m=2.5))
    assert scene.openings == (DOOR, window)
    assert scene.ceiling_m == 2.5


@pytest.mark.parametrize(
    ("opening", "said"),
    [
        (Opening("door", (3.0, 1.0), (3.0, 1.9), 0.0, 2.0), "is not on one side of the floor"),
        (Opening("door", (4.0, 2.8), (4.0, 3.6), 0.0, 2.0), "is not on one side of the floor"),
        (Opening("door", (4.0, 1.0), (4.0, 1.0), 0.0, 2.0), "is not on one side of the floor"),
        (Opening("window", (4.0, 1.0), (4.0, 1.9), 2.1, 0.9), "from 2.1 to 0.9 m above"),
        (Opening("window", (4.0, 1.0), (4.0, 1.9), -1.0, 0.9), "from -1 to 0.9 m above"),
    ],
)
def test_an_opening_without_a_wall_is_refused(tmp_path, opening, said):
    with pytest.raises(InputError, match=said):
        read_scene(written(tmp_path, opening))


def test_an_opening_needs_a_floor(tmp_path):
    with pytest.raises(InputError, match="give floor_m, too"):
        read_scene(written(tmp_path, DOOR, floor=None))


def with_solid(solid: Solid) -> Scene:
    chair = SceneObject("chair", (1.0, 0.5, 0.0), (0.5, 1.0, 0.5), solids=(solid,))
    return Scene("room", "front3d_bedroom", (chair,))


def test_solids_come_back(tmp_path):
    solid = Solid("dome", (0.8, 0.0, -0.25), (1.2, 0.5, 0.25))
    path = tmp_path / "room.json"
    path.write_text(json.dumps(scene_to_json(with_solid(solid))))
    assert read_scene(path).objects[0].solids == (solid,)


@pytest.mark.parametrize(
    ("solid", "said"),
    [
        (Solid("box", (-0.2, 0.0, -0.2), (0.2, 0.5, 0.2)), "which is not in its box"),
        (Solid("box", (0.8, 0.5, -0.2), (1.2, 0.5, 0.2)), "low_m below high_m"),
        (Solid("box", (0.8, 0.0, -0.2), (1.2, float("nan"), 0.2)), "low_m below high_m"),
    ],
)
def test_solids_elsewhere_are_refused(tmp_path, solid, said):
    path = tmp_path / "room.json"
    path.write_text(json.dumps(scene_to_json(with_solid(solid))))
    with pytest.raises(InputError, match=said):
        read_scene(path)
