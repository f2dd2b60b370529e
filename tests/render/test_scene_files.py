"""Scene files: what is in them, and that they come back as they went."""

import json
import re
import struct
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from gltf import validate
from PIL import Image

from sceneprior.apps.rooms import write_scene, write_scenes
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.scene import (
    Mesh,
    Scene,
    SceneObject,
    Turned,
    bound_m,
    mesh_of_file,
    quarter_turned,
)
from sceneprior.core.scene_json import scene_to_json
from sceneprior.render.appearance import quiet_colors
from sceneprior.render.scene_files import (
    load_scene,
    load_scene_folder,
    read_glb_parts,
    save,
    scene_to_glb,
)
from sceneprior.render.topdown import floor_plan, topdown


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


def glb_json(data: bytes) -> dict:
    length = struct.unpack("<I", data[12:16])[0]
    return json.loads(data[20 : 20 + length])


def test_boxes_are_plain_floats_whatever_they_were():
    item = SceneObject("desk", tuple(np.array([0, 0.5, 0])), tuple(np.ones(3)))
    assert repr(item.center_m + item.size_m) == "(0.0, 0.5, 0.0, 1.0, 1.0, 1.0)"


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
    assert glb_json(scene_to_glb(scene))["scenes"][0]["extras"] == {"sceneprior": told}
    empty = glb_json(scene_to_glb(replace(scene, objects=())))
    assert empty["scenes"][0]["extras"] == {"sceneprior": {**told, "objects": []}}


def test_the_glb_has_named_nodes_in_metres_and_class_colours(scene):
    content = glb_json(scene_to_glb(scene))
    assert [node["name"] for node in content["nodes"]] == ["0_double_bed", "1_nightstand"]
    assert not any("matrix" in node or "scale" in node for node in content["nodes"])
    bounds = [accessor for accessor in content["accessors"] if accessor["type"] == "VEC3"]
    np.testing.assert_allclose(bounds[0]["max"], [1, 1.5, 1])  # y is up
    np.testing.assert_allclose(bounds[1]["min"], [1.25, 0, -0.7], atol=1e-6)
    for label, material in zip((9, 13), content["materials"], strict=True):
        linear = np.array(material["pbrMetallicRoughness"]["baseColorFactor"][:3])
        srgb = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
        # trimesh keeps 8 bits of linear light: up to 6 of 255 steps in a dark channel.
        np.testing.assert_allclose(
            srgb * 255, quiet_colors(label_set("front3d_bedroom"))[label], atol=6
        )


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
    low, high = (getattr(back.objects[1].mesh.vertices_m, end)(0) for end in ("min", "max"))
    np.testing.assert_allclose((high + low) / 2, (1.5, 0.25, -0.5), atol=1e-6)
    np.testing.assert_allclose(high - low, (0.5, 0.5, 0.4), atol=1e-6)
    picture = np.asarray(Image.open(tmp_path / "new" / "room_0.png"))
    np.testing.assert_array_equal(picture, floor_plan(scene))
    np.testing.assert_array_equal(topdown(back), topdown(scene))


def test_node_transforms_are_applied(tmp_path):
    import trimesh

    moved = trimesh.Scene()
    shift = trimesh.transformations.translation_matrix([1.0, 2.0, 3.0])
    moved.add_geometry(trimesh.creation.box(), node_name="0_desk", transform=shift)
    (tmp_path / "a.glb").write_bytes(moved.export(file_type="glb"))
    ((mesh, _, _),) = read_glb_parts(tmp_path / "a.glb")["0_desk"]
    np.testing.assert_allclose(mesh.vertices_m.mean(0), [1, 2, 3], atol=1e-6)


def test_the_same_scene_gives_the_same_bytes(scene):
    assert scene_to_glb(scene) == scene_to_glb(scene)


def test_an_empty_room_is_a_valid_glb_and_comes_back_empty(scene, tmp_path):
    write_scene(replace(scene, objects=()), tmp_path, "empty")
    data = (tmp_path / "empty.glb").read_bytes()
    assert data[:4] == b"glTF" and struct.unpack("<I", data[8:12])[0] == len(data)
    assert load_scene(tmp_path / "empty.json").objects == ()


def test_a_folder_is_read_in_counting_order_and_other_json_is_passed_over(scene, tmp_path):
    for index in (10, 2, 1):
        write_scene(replace(scene, name=f"n{index}"), tmp_path, f"room_{index}")
    (tmp_path / "scores.json").write_text('{"format": "sceneprior-scores"}')
    (tmp_path / "room_2.glb").unlink()
    scenes = load_scene_folder(tmp_path)
    assert [item.name for item in scenes] == ["n1", "n2", "n10"]
    assert scenes[0].objects[0].mesh is not None and scenes[1].objects[0].mesh is None


def test_bad_folders_and_files_say_what_to_do(scene, tmp_path):
    with pytest.raises(InputError, match="No folder of scenes at"):
        load_scene_folder(tmp_path / "absent")
    with pytest.raises(InputError, match="holds no scene JSON"):
        load_scene_folder(tmp_path)
    write_scene(scene, tmp_path, "room")
    (tmp_path / "room.glb").write_bytes(b"glTF nothing")
    with pytest.raises(InputError, match="cannot be read as a GLB"):
        load_scene_folder(tmp_path)
    (tmp_path / "room.glb").write_bytes(scene_to_glb(replace(scene, objects=scene.objects[:1])))
    with pytest.raises(InputError, match=r"different objects .*1_nightstand"):
        load_scene_folder(tmp_path)
    for text in ("{", "[" * 100_000):
        (tmp_path / "room.json").write_text(text)
        with pytest.raises(InputError, match=r"room\.json is not JSON"):
            load_scene_folder(tmp_path)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"center_m": [0.0, float("nan"), 0.0]}, r"a desk has centre \[0\.0, nan, 0\.0\]"),
        ({"size_m": [1.0, -1.0, 1.0]}, "sizes above 0"),
        ({"size_m": [180.0, 50, 200]}, r"is above 20 m long.* Are these centimetres\?"),
        ({"size_m": [1800, 500, 2000]}, r"Are these millimetres\? Give metres\."),
        ({"center_m": [150.0, 25, 60]}, r"100 m from the floor's centre\. Are these centimetres"),
        ({"center_m": ["0", "1", "2"]}, r"objects\.0\.center_m\.0 is .0.; input should be a valid"),
        ({"yaw_rad": 0.3}, "expected both"),
        ({"yaw_rad": 0.3, "own_size_m": [1.0, 0.8, 0.5]}, "the box turned by yaw_rad fills size_m"),
    ],
)
def test_numbers_that_no_room_has_are_refused(tmp_path, change, sentence):
    desk = SceneObject("desk", (0.0, 0.4, 0.0), (1.0, 0.8, 0.5))
    data = scene_to_json(Scene("a", "front3d_bedroom", (desk,)))
    data["objects"][0] |= change
    (tmp_path / "a.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match=sentence):
        load_scene(tmp_path / "a.json")


def test_what_room_files_cannot_hold_is_refused(tmp_path):
    desk = SceneObject("desk", (0.0, 0.4, 0.0), (1.0, 0.8, 0.5))
    data = scene_to_json(Scene("a", "front3d_bedroom", (desk,)))
    for change, sentence in (
        ({"objects": data["objects"] * 20_000}, "at most 1000 items"),
        ({"extra": {"a": float("nan")}}, "is not a scene JSON"),
        ({"floor_m": [[0, 0], [400, 0], [400, 300]]}, "the floor reaches 400 m.* centimetres"),
        ({"floor_m": [[0, 0], [1, 0]]}, r"a\.json is not a scene JSON.*floor_m"),
        ({"floor_m": [[0, 0], [1], [2, 2]]}, r"a\.json is not a scene JSON.*floor_m"),
        ({"version": "x" * 9999}, "x{60}; expected 'sceneprior-scene' version 1"),
    ):
        (tmp_path / "a.json").write_text(json.dumps(data | change))
        with pytest.raises(InputError, match=sentence) as error:
            load_scene(tmp_path / "a.json")
        assert len(str(error.value)) < 500


def test_flat_sides_stay_above_zero(tmp_path):
    flat = SceneObject("table", (0.0, 0.0, 0.0), (1.0, 0.0, 1.0))
    save(Scene("a", "front3d_bedroom", (flat,)), tmp_path / "a.json")
    assert load_scene(tmp_path / "a.json").objects[0].size_m == (1.0, 1e-5, 1.0)


def test_turned_boxes_come_back(tmp_path):
    turned = Turned(0.5, (1.8, 0.6, 2.0))
    bed = SceneObject("double_bed", (0.0, 0.3, 0.0), bound_m(turned), turned=turned)
    save(Scene("a", "front3d_bedroom", (bed,)), tmp_path / "a.json")
    (back,) = load_scene(tmp_path / "a.json").objects
    assert back.turned == turned
    # In another box it is no longer known.
    assert back.in_box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)).turned is None


@pytest.mark.parametrize(
    ("vertices", "faces", "sentence"),
    [
        (np.zeros((3, 2)), np.zeros((1, 3), int), r"vertices \(3, 2\) and faces \(1, 3\)"),
        (np.zeros((3, 3)), np.zeros((1, 3)), "faces of float64; expected metres and whole"),
        (np.full((3, 3), np.inf), np.zeros((1, 3), int), "vertices that are not finite"),
        (np.zeros((3, 3)), np.array([[0, 1, 3]]), "names vertex 3, but its 3 vertices are 0 to 2"),
    ],
)
def test_arrays_that_are_no_mesh_are_refused(vertices, faces, sentence):
    with pytest.raises(InputError, match=sentence):
        Mesh(vertices, faces)
    with pytest.raises(InputError, match="has no triangle"):
        mesh_of_file(np.zeros((3, 3)), np.zeros((0, 3), int))


@pytest.mark.parametrize(
    ("part", "value", "sentence"),
    [
        ("indices", struct.pack("<I", 70_000), "a face of a mesh names vertex 70000"),
        ("POSITION", struct.pack("<f", np.nan), "not finite"),
    ],
)
def test_a_damaged_mesh_of_a_glb_is_refused(scene, tmp_path, part, value, sentence):
    save(scene, tmp_path / "a.json")
    glb = bytearray(scene_to_glb(scene))
    content = glb_json(glb)
    primitive = content["meshes"][0]["primitives"][0]
    accessor = content["accessors"][(primitive | primitive["attributes"])[part]]
    start = 28 + struct.unpack("<I", glb[12:16])[0]
    start += content["bufferViews"][accessor["bufferView"]]["byteOffset"]
    glb[start : start + 4] = value
    (tmp_path / "a.glb").write_bytes(glb)
    with pytest.raises(InputError, match=f"(?i)a.glb cannot be read as a GLB .*{sentence}"):
        load_scene(tmp_path / "a.json")


def test_rooms_need_names_for_their_files(scene, tmp_path):
    with pytest.raises(InputError, match="2 rooms are called 'room'"):
        write_scenes([scene, scene], tmp_path / "new")
    with pytest.raises(InputError, match="A room is called 'a/b', which cannot be the name"):
        write_scenes([replace(scene, name="a/b")], tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_box_lists_in_place_of_scenes_are_sent_to_their_command(tmp_path):
    told = r"holds box lists \({}\), not scenes; `sceneprior export .* --to scenes --label-set"
    (tmp_path / "a").mkdir()
    np.savez(tmp_path / "a" / "boxes.npz", class_labels=np.zeros((1, 23)))
    for given in (tmp_path, tmp_path / "a" / "boxes.npz"):
        with pytest.raises(InputError, match=told.format(r"boxes\.npz")):
            load_scene_folder(given)
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "rooms.json").write_text('[{"class_labels": []}]')
    with pytest.raises(InputError, match=told.format(r"rooms\.json")):
        load_scene_folder(tmp_path / "b")
    np.savez(tmp_path / "b" / "latents.npz", z=np.zeros(3))
    (tmp_path / "b" / "rooms.json").write_text("[]")
    with pytest.raises(InputError, match="holds no scene JSON"):
        load_scene_folder(tmp_path / "b")


def test_floors_without_area_are_refused_when_read(tmp_path):
    for floor in ([[0, 0], [1, 1], [3, 3]], [[1, 2]] * 3):
        data = scene_to_json(Scene("a", "front3d_bedroom")) | {"floor_m": floor}
        (tmp_path / "a.json").write_text(json.dumps(data))
        with pytest.raises(InputError, match=r"a\.json: all corners of the floor lie on one line"):
            load_scene(tmp_path / "a.json")


def test_an_obj_has_a_named_object_each_in_metres_and_its_class_colour(scene, tmp_path):
    save(replace(scene, objects=(*scene.objects, scene.objects[1])), tmp_path / "a.obj")
    vertices, faces, materials = [], {}, {}
    for kind, *words in map(str.split, filter(None, (tmp_path / "a.obj").read_text().splitlines())):
        if kind == "o":
            (name,) = words
            faces[name] = []
        elif kind == "usemtl":
            materials[name] = words[0]
        elif kind == "v":
            vertices.append([float(word) for word in words])
        elif kind == "f":
            faces[name].append([int(word) - 1 for word in words])
    assert list(faces) == ["0_double_bed", "1_nightstand", "2_nightstand"]
    vertices = np.array(vertices)
    np.testing.assert_allclose(
        vertices[faces["0_double_bed"]],
        scene.objects[0].mesh.vertices_m[scene.objects[0].mesh.faces],
        atol=1e-7,
    )
    corners = vertices[np.ravel(faces["1_nightstand"])]
    np.testing.assert_allclose(corners.min(0), [1.25, 0, -0.7], atol=1e-7)
    blocks = (tmp_path / "a.mtl").read_text().split("newmtl ")[1:]
    colors = {b.split()[0]: re.search(r"Kd (.*)", b)[1] for b in blocks}
    assert colors[materials["1_nightstand"]] == colors[materials["2_nightstand"]]
    assert colors[materials["1_nightstand"]] != colors[materials["0_double_bed"]]
    save(replace(scene, objects=()), tmp_path / "none.obj")
    assert (tmp_path / "none.obj").read_text() == ""


def test_a_room_with_walls_is_read_as_its_furniture(tmp_path):
    bed = SceneObject("double_bed", (0.0, 0.3, 0.0), (1.8, 0.6, 2.0))
    scene = Scene("a", "front3d_bedroom", (bed,))
    for ending in (".glb", ".obj", ".json"):
        save(scene, tmp_path / f"a{ending}", shell="walls")
    loaded = trimesh.load_scene(tmp_path / "a.glb")
    shell = ["floor", "wall_0", "wall_1", "wall_2", "wall_3", "ceiling"]
    assert set(loaded.graph.nodes_geometry) == {"0_double_bed", *shell}
    assert loaded.bounds[0] == pytest.approx([-1.2, -0.1, -1.3])
    named = re.findall(r"^o (.*)$", (tmp_path / "a.obj").read_text(), re.MULTILINE)
    assert sorted(named) == sorted(["0_double_bed", *shell])
    (item,) = load_scene(tmp_path / "a.json").objects
    assert len(item.mesh.faces) == 12


@pytest.mark.parametrize("shell", ["none", "floor", "walls"])
def test_the_gltf_validator_finds_nothing(tmp_path, shell):
    bed = SceneObject("double_bed", (0.0, 0.3, 0.0), (1.8, 0.6, 2.0))
    save(Scene("a", "front3d_bedroom", (bed,)), tmp_path / "a.glb", shell=shell)
    validate(tmp_path / "a.glb")
