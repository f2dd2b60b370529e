"""Rooms go out in other formats and come back: axes, units, classes, floors."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import shapely

from data_prep.front.furnished import ModelBank
from data_prep.front.houses import read_house
from data_prep.front.recipe import load_recipe
from sceneprior.apps.rooms import write_scenes
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Mesh, Scene, SceneObject
from sceneprior.interchange.box_lists import read_box_lists, turned_box
from sceneprior.interchange.export import SIMULATORS, Notes, export_scenes
from sceneprior.render.scene_files import load_scene_folder

BEDROOM = "front3d_bedroom"
FLOOR = np.array([[-2.0, -1.5], [2.0, -1.5], [2.0, 1.5], [0.0, 1.5], [0.0, 0.5], [-2.0, 0.5]])
"""An L; its bounding box is about the origin."""
PYRAMID = Mesh(
    np.array([[-1.0, 0.1, -1], [0.6, 0.1, -1], [0.6, 0.1, 1], [-1.0, 0.1, 1], [-0.2, 0.9, 0.4]]),
    np.array([[0, 1, 2], [0, 2, 3], [0, 4, 1], [1, 4, 2], [2, 4, 3], [3, 4, 0]]),
)


@pytest.fixture
def scenes() -> list[Scene]:
    bed = SceneObject("double_bed", (-0.2, 0.5, 0.0), (1.6, 0.8, 2.0), PYRAMID)
    lamp = SceneObject("pendant_lamp", (1.0, 2.2, -0.5), (0.3, 0.4, 0.2))
    return [Scene("first", BEDROOM, (bed, lamp), FLOOR), Scene("second", BEDROOM, (lamp,))]


def test_angles_of_box_lists_come_back(tmp_path):
    """ATISS -> scenes -> ATISS, through files: quarter turns and others, and negative ones."""
    angles = np.array([0.0, np.pi / 2, -np.pi / 2, np.pi, 0.4, -2.1, np.pi / 4])
    rng = np.random.default_rng(0)
    theirs = {
        "class_labels": np.eye(23)[rng.integers(0, 21, len(angles))],
        "translations": rng.uniform(-2, 2, (len(angles), 3)),
        "sizes": rng.uniform(0.2, 1, (len(angles), 3)),
        "angles": angles[:, None],
    }
    (tmp_path / "theirs" / "a").mkdir(parents=True)
    np.savez(tmp_path / "theirs" / "a" / "boxes.npz", **theirs)
    write_scenes(read_box_lists(tmp_path / "theirs", BEDROOM), tmp_path / "s")
    # Boxes are boxes again, or solids if they are turned, so that physics needs no parts of meshes.
    for item in load_scene_folder(tmp_path / "s")[0].objects:
        assert (item.mesh is None) == (not item.solids)
    for kept in ("meshes", "boxes"):
        if kept == "boxes":
            (tmp_path / "s" / "a.glb").unlink()
        assert export_scenes(load_scene_folder(tmp_path / "s"), "atiss", tmp_path / kept) == Notes()
        with np.load(tmp_path / kept / "a" / "boxes.npz") as back:
            for key, values in theirs.items():
                np.testing.assert_allclose(back[key], values, atol=1.1e-5, err_msg=key)


@pytest.mark.parametrize("to", ["atiss", "threed-front"])
def test_void_is_left_out_and_odd_floors_are_handled(scenes, tmp_path, to):
    void = SceneObject("void", (0.0, 0.5, 0.0), (1.0, 1.0, 1.0))
    first = replace(scenes[0], objects=(void, *scenes[0].objects))
    ((note,),) = filter(None, export_scenes([first], to, tmp_path / "void"))
    assert note == f"Objects of class void are left out (1): {to} has no such class."
    for floor in (
        [[-1, -1], [1, 1], [1, -1], [-1, 1]],  # crosses itself
        [[-1, -1], [1, -1], [1, 1], [-1, -1], [-1, -1]],  # closed, and a corner twice
    ):
        odd = replace(first, floor_m=np.array(floor, dtype=float), name="odd")
        export_scenes([odd], to, tmp_path / "odd")
    flat = replace(first, floor_m=np.array([[0.0, 0], [1, 0], [2, 0]]))
    with pytest.raises(InputError, match="The floor of scene 'first' has no area"):
        export_scenes([flat], to, tmp_path / "flat")


def test_3d_front_s_reader_finds_the_rooms_and_their_models(scenes, tmp_path):
    export_scenes(scenes, "threed-front", tmp_path)
    bank, recipe = ModelBank(tmp_path / "3D-FUTURE-model"), load_recipe("bedroom")
    found = read_house(tmp_path / "3D-FRONT" / "first.json", bank, recipe)
    assert not found.left_out
    (room,) = found.rooms
    assert (room.type, room.room_id) == ("Bedroom", "first_Bedroom-0")
    assert room.floor.symmetric_difference(shapely.Polygon(FLOOR)).area < 1e-6
    bed, lamp = room.furniture
    assert (bed.label, lamp.label) == ("double_bed", "pendant_lamp")
    np.testing.assert_allclose(bed.mesh.vertices_m, PYRAMID.vertices_m, atol=1e-5)
    np.testing.assert_array_equal(bed.mesh.faces, PYRAMID.faces)
    low, high = (getattr(lamp.mesh.vertices_m, end)(axis=0) for end in ("min", "max"))
    np.testing.assert_allclose((low + high) / 2, (1.0, 2.2, -0.5), atol=1e-5)
    np.testing.assert_allclose(high - low, (0.3, 0.4, 0.2), atol=1e-5)
    # Without a floor, one is put under the furniture, and the room is about its centre.
    (other,) = read_house(tmp_path / "3D-FRONT" / "second.json", bank, recipe).rooms
    np.testing.assert_allclose(other.furniture[0].mesh.vertices_m.mean(0), (0, 2.2, 0), atol=1e-5)


@pytest.mark.parametrize("yaw_rad", [np.pi / 2, np.pi, -2.1, 0.4])
def test_3d_front_s_reader_finds_boxes_and_their_yaws(tmp_path, yaw_rad):
    size = (1.6, 0.8, 2.0)
    bed = turned_box("double_bed", np.array([0.3, 0.4, -0.2]), np.array(size), yaw_rad)
    export_scenes([Scene("room", BEDROOM, (bed,), FLOOR)], "threed-front", tmp_path)
    house, bank = tmp_path / "3D-FRONT" / "room.json", ModelBank(tmp_path / "3D-FUTURE-model")
    (room,) = read_house(house, bank, load_recipe("bedroom")).rooms
    (found,) = room.furniture
    assert np.exp(1j * (found.yaw_rad - yaw_rad)) == pytest.approx(1, abs=1e-6)
    low, high = (getattr(found.mesh.vertices_m, end)(axis=0) for end in ("min", "max"))
    np.testing.assert_allclose((low + high) / 2, bed.center_m, atol=1e-5)
    np.testing.assert_allclose(high - low, bed.size_m, atol=1e-5)
    np.testing.assert_allclose(np.ptp(found.model.vertices_m, axis=0), size, atol=1e-5)
    (told,) = json.loads(house.read_text())["furniture"]
    assert told["size"] == [1.6, 2.0, 0.8]


def test_what_cannot_be_exported_is_a_sentence(scenes, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    for rooms, to, shell, sentence in (
        (scenes, "max", None, "No format 'max'; choose from atiss, threed-front, mujoco, usd"),
        (scenes[:1] * 2, "obj", None, "2 rooms are called 'first'"),
        (scenes, "atiss", "walls", "The format atiss has no choice of walls"),
        (scenes, "usd", None, r"USD needs another package: pip install 'sceneprior\[us"),
    ):
        with pytest.raises(InputError, match=sentence):
            export_scenes(rooms, to, tmp_path, shell)


ODD = ("tv/stereo", "../up", "..", "a:b?", "床" * 60)


@pytest.mark.parametrize("to", [*SIMULATORS, "sceneeval", "obj", "scenes"])
def test_no_class_leads_out_of_a_folder(tmp_path, to):
    if to == "usd":
        pytest.importorskip("pxr", reason="the extra `usd` is not installed")
    names = ",".join(("void", *ODD))
    objects = [SceneObject(c, (2.0 * i, 0.5, 0.0), (1.0, 1.0, 1.0)) for i, c in enumerate(ODD)]
    there = {}
    for plain in (False, True):
        out = tmp_path / str(plain) / "out"
        items = [replace(o, label="bed") for o in objects] if plain else objects
        scene = Scene("room", "void,bed" if plain else names, tuple(items), FLOOR * 9)
        if to == "scenes":
            write_scenes([scene], out)
            assert [o.label for o in load_scene_folder(out)[0].objects] == [o.label for o in items]
        else:
            export_scenes([scene], to, out)
        depths = [len(path.relative_to(out.parent).parts) for path in out.parent.rglob("*")]
        there[plain] = sorted(depths)
    assert there[False] == there[True]
