"""Scene files: what is in them, and that they come back as they went."""

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from gltf import json_of, validate
from PIL import Image
from refusals import refused

from sceneprior.apps.rooms import write_scene, write_scenes
from sceneprior.core.scene import (
    Mesh,
    Scene,
    SceneObject,
    mesh_of_file,
    quarter_turned,
)
from sceneprior.core.scene_json import scene_to_json
from sceneprior.render.appearance import linear_rgba, object_colors
from sceneprior.render.model_files import load_parts
from sceneprior.render.scene_files import (
    load_scene,
    load_scene_folder,
    read_glb_parts,
    save,
    scene_to_glb,
)
from sceneprior.render.topdown import floor_plan, topdown

BEDROOM = "front3d_bedroom"
DESK = SceneObject("desk", (0.0, 0.4, 0.0), (1.0, 0.8, 0.5))


@pytest.fixture
def scene() -> Scene:
    pyramid = Mesh(
        np.array([[-1.0, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1], [0, 1.5, 0]]),
        np.array([[0, 1, 2], [0, 2, 3], [0, 4, 1], [1, 4, 2], [2, 4, 3], [3, 4, 0]]),
    )
    return Scene(
        "room",
        "front3d_bedroom",
        (
            SceneObject("double_bed", (0.0, 0.75, 0.0), (2.0, 1.5, 2.0), pyramid),
            SceneObject("nightstand", (1.5, 0.25, -0.5), (0.5, 0.5, 0.4)),
        ),
        extra={"seed": 3},
    )


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_models_read_from_a_saved_room_have_its_colours(scene, suffix, tmp_path):
    save(scene, tmp_path / f"room{suffix}")
    parts = load_parts(tmp_path / f"room{suffix}", suffix[1:], with_materials=True)
    read = [[*map(float, part.material.baseColorFactor[:3])] for part in parts.values()]
    colors = [255 * np.array(linear_rgba(color)[:3]) for color in object_colors(scene)]
    np.testing.assert_allclose(sorted(read), sorted(map(list, colors)), atol=1)


def test_the_glb_says_what_it_shows(scene):
    """The origin of the scene and the yaw of each object, where it is known."""
    turned = replace(scene.objects[1], turned=quarter_turned(scene.objects[1].size_m, 1))
    scene = replace(scene, objects=(scene.objects[0], turned))
    told = {
        "name": "room",
        "label_set": "front3d_bedroom",
        "extra": {"seed": 3},
        "objects": [
            {"node": "0_double_bed", "class": "double_bed"},
            {"node": "1_nightstand", "class": "nightstand", "yaw_rad": 1.5707963},
        ],
    }
    assert json_of(scene_to_glb(scene))["scenes"][0]["extras"] == {"sceneprior": told}
    empty = json_of(scene_to_glb(replace(scene, objects=())))
    assert empty["scenes"][0]["extras"] == {"sceneprior": {**told, "objects": []}}


def test_what_is_written_comes_back(scene, tmp_path):
    write_scene(scene, tmp_path / "new", "room_0")
    files = sorted(path.name for path in (tmp_path / "new").iterdir())
    assert files == ["room_0.glb", "room_0.json", "room_0.png"]
    back = load_scene(tmp_path / "new" / "room_0.json")
    assert (back.name, back.label_set, back.extra) == ("room", "front3d_bedroom", {"seed": 3})
    np.testing.assert_allclose(back.centers_m, scene.centers_m)
    bed = back.objects[0].mesh
    np.testing.assert_array_equal(bed.vertices_m, scene.objects[0].mesh.vertices_m)
    np.testing.assert_array_equal(bed.faces, scene.objects[0].mesh.faces)
    assert back.objects[1].mesh is None  # its node is a box
    np.testing.assert_allclose(back.sizes_m, scene.sizes_m)
    picture = np.asarray(Image.open(tmp_path / "new" / "room_0.png"))
    np.testing.assert_array_equal(picture, floor_plan(scene))
    np.testing.assert_array_equal(topdown(back), topdown(scene))


def test_node_transforms_are_applied(tmp_path):

    moved = trimesh.Scene()
    shift = trimesh.transformations.translation_matrix([1.0, 2.0, 3.0])
    moved.add_geometry(trimesh.creation.box(), node_name="0_desk", transform=shift)
    (tmp_path / "a.glb").write_bytes(moved.export(file_type="glb"))
    ((mesh, _, _),) = read_glb_parts(tmp_path / "a.glb")["0_desk"]
    np.testing.assert_allclose(mesh.vertices_m.mean(0), [1, 2, 3], atol=1e-6)


def test_a_folder_is_read_in_counting_order_and_other_json_is_passed_over(scene, tmp_path):
    for index in (10, 2, 1):
        write_scene(replace(scene, name=f"n{index}"), tmp_path, f"room_{index}")
    (tmp_path / "scores.json").write_text('{"format": "sceneprior-scores"}')
    (tmp_path / "room_2.glb").unlink()
    scenes = load_scene_folder(tmp_path)
    assert [item.name for item in scenes] == ["n1", "n2", "n10"]
    assert scenes[0].objects[0].mesh is not None and scenes[1].objects[0].mesh is None


def test_flat_sides_stay_above_zero(tmp_path):
    flat = SceneObject("table", (0.0, 0.0, 0.0), (1.0, 0.0, 1.0))
    save(Scene("a", "front3d_bedroom", (flat,)), tmp_path / "a.json")
    assert load_scene(tmp_path / "a.json").objects[0].size_m == (1.0, 1e-5, 1.0)


@pytest.mark.parametrize("shell", ["none", "floor", "walls"])
def test_the_gltf_validator_finds_nothing(tmp_path, shell):
    bed = SceneObject("double_bed", (0.0, 0.3, 0.0), (1.8, 0.6, 2.0))
    save(Scene("a", "front3d_bedroom", (bed,)), tmp_path / "a.glb", shell=shell)
    validate(tmp_path / "a.glb")


def file_of(**changes: object) -> Callable[[Path], object]:
    """Read a scene's JSON with these entries."""

    def case(folder: Path) -> object:
        data = scene_to_json(ONE) | changes
        (folder / "a.json").write_text(json.dumps(data))
        return load_scene(folder / "a.json")

    return case


def desk(**changes: object) -> Callable[[Path], object]:
    """Read a scene's JSON whose only object has these entries."""
    (entry,) = scene_to_json(ONE)["objects"]
    return file_of(objects=[entry | changes])


def folder_of(**files: str | bytes) -> Callable[[Path], object]:
    """Read a folder of a scene and of these files, whose names have _ for the dot."""

    def case(folder: Path) -> object:
        save(ONE, folder / "room.json")
        for name, content in files.items():
            content = content.encode() if isinstance(content, str) else content
            (folder / name.replace("_", ".")).write_bytes(content)
        return load_scene_folder(folder)

    return case


def boxes_of_atiss(folder: Path) -> object:
    (folder / "deep").mkdir()
    np.savez(folder / "deep" / "boxes.npz", class_labels=np.zeros((1, 23)))
    return load_scene_folder(folder)


def damaged_glb(part: str, value: bytes) -> Callable[[Path], object]:
    """Read a scene whose GLB has other bytes at the start of an accessor."""

    def case(folder: Path) -> object:
        glb = bytearray(scene_to_glb(ONE))
        content = json_of(bytes(glb))
        primitive = content["meshes"][0]["primitives"][0]
        accessor = content["accessors"][(primitive | primitive["attributes"])[part]]
        start = 28 + struct.unpack("<I", glb[12:16])[0]
        start += content["bufferViews"][accessor["bufferView"]]["byteOffset"]
        glb[start : start + 4] = value
        return folder_of(room_glb=bytes(glb))(folder)

    return case


def mesh(vertices: np.ndarray, faces: np.ndarray) -> Callable[[Path], object]:
    return lambda _: mesh_of_file(vertices, faces)


LINE, NOTHING, ONE = [[0, 0], [1, 1], [3, 3]], Scene("a", BEDROOM), Scene("a", BEDROOM, (DESK,))
CASES: dict[str, Callable[[Path], object]] = {
    "file in place of a folder": lambda folder: load_scene_folder(
        file_of()(folder) and folder / "a.json"
    ),
    "no folder": lambda folder: load_scene_folder(folder / "absent"),
    "folder without scenes": load_scene_folder,
    "glb of other objects": folder_of(room_glb=scene_to_glb(Scene("a", BEDROOM, (DESK, DESK)))),
    "glb with a face of no vertex": damaged_glb("indices", struct.pack("<I", 70_000)),
    "glb with a vertex that is no number": damaged_glb("POSITION", struct.pack("<f", np.nan)),
    "json cut": folder_of(room_json="{"),
    "json deep": folder_of(room_json="[" * 100_000),
    "box lists": boxes_of_atiss,
    "box lists in JSON": folder_of(room_json='[{"class_labels": []}]'),
    "list of nothing": folder_of(room_json="[]"),
    "centre of no number": desk(center_m=[0.0, float("nan"), 0.0]),
    "negative size": desk(size_m=[1.0, -1.0, 1.0]),
    "centimetres": desk(size_m=[180.0, 50, 200]),
    "millimetres": desk(size_m=[1800, 500, 2000]),
    "far away": desk(center_m=[150.0, 25, 60]),
    "centre of words": desk(center_m=["0", "1", "2"]),
    "yaw alone": desk(yaw_rad=0.3),
    "yaw of another box": desk(yaw_rad=0.3, own_size_m=[1.0, 0.8, 0.5]),
    "too many objects": file_of(objects=scene_to_json(ONE)["objects"] * 1001),
    "extra of no number": file_of(extra={"a": float("nan")}),
    "floor in centimetres": file_of(floor_m=[[0, 0], [400, 0], [400, 300]]),
    "floor of two corners": file_of(floor_m=[[0, 0], [1, 0]]),
    "floor of odd corners": file_of(floor_m=[[0, 0], [1], [2, 2]]),
    "floor on a line": file_of(floor_m=LINE),
    "floor of a point": file_of(floor_m=[[1, 2]] * 3),
    "long version": file_of(version="x" * 9999),
    "two rooms of a name": lambda folder: write_scenes([NOTHING, NOTHING], folder / "new"),
    "name with a slash": lambda folder: write_scenes([Scene("a/b", BEDROOM)], folder / "new"),
    "mesh of flat vertices": mesh(np.zeros((3, 2)), np.zeros((1, 3), int)),
    "mesh of broken faces": mesh(np.zeros((3, 3)), np.zeros((1, 3))),
    "mesh without end": mesh(np.full((3, 3), np.inf), np.zeros((1, 3), int)),
    "mesh with a face of no vertex": mesh(np.zeros((3, 3)), np.array([[0, 1, 3]])),
    "mesh of no triangle": mesh(np.zeros((3, 3)), np.zeros((0, 3), int)),
}


@pytest.mark.parametrize("name", CASES)
def test_refused(name, tmp_path):
    with refused(f"render/{name}", tmp=tmp_path):
        CASES[name](tmp_path)
    assert not (tmp_path / "new").exists()
