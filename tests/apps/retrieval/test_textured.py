"""Materials of CAD models go through `retrieve` into GLBs: images, texture coordinates, colours."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from gltf import images_of, json_of, validate
from PIL import Image

from sceneprior.apps.retrieval.cad_models import open_models, read_textured
from sceneprior.apps.retrieval.retrieve import retrieve
from sceneprior.apps.rooms import write_scenes
from sceneprior.core.boxes import quarter_rotation
from sceneprior.core.colliders import closed_components
from sceneprior.core.errors import InputWarning
from sceneprior.core.scene import Scene, SceneObject, quarter_turned
from sceneprior.interchange.export import export_scenes
from sceneprior.render.model_files import LARGEST_PX
from sceneprior.render.scene_files import load_scene, save, scene_to_obj

SEAT = (2.0, 0.4, 0.8)
PIXELS = np.random.default_rng(0).integers(0, 256, (8, 8, 3), dtype=np.uint8)
RED = (1.0, 0.0, 0.0)
SIZE = (0.9, 0.6, 2.2)
SOFA = SceneObject("sofa", (0.5, 0.3, -0.2), SIZE, turned=quarter_turned(SIZE, 1))


def box_lines(low: np.ndarray, high: np.ndarray, first: int) -> tuple[list[str], list[str]]:
    """Vertices of a box, each with its place from above as its texture coordinates, and faces."""
    box = trimesh.creation.box(bounds=[low, high])
    points = [f"v {x} {y} {z}" for x, y, z in box.vertices]
    points += [f"vt {x / SEAT[0] + 0.5} {z / SEAT[2] + 0.5}" for x, _, z in box.vertices]
    faces = [" ".join(f"{first + k}/{first + k}" for k in face) for face in box.faces]
    return points, [f"f {face}" for face in faces]


def write_sofa(path: Path, image: Image.Image | None = None) -> Path:
    """An OBJ of two closed boxes: a seat with a texture, and a red back."""
    path.parent.mkdir(parents=True, exist_ok=True)
    (image or Image.fromarray(PIXELS)).save(path.parent / "texture.png")
    (path.parent / "model.mtl").write_text(
        "newmtl cloth\nmap_Kd ./texture.png\nnewmtl red\nKd 1 0 0\n"
    )
    seat, on_seat = box_lines([-1, 0, -0.4], [1, 0.4, 0.4], 1)
    back, on_back = box_lines([-1, 0.4, -0.4], [1, 0.8, -0.2], 9)
    lines = ["mtllib model.mtl", *seat, *back, "usemtl cloth", *on_seat, "usemtl red", *on_back]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(params=["own.obj", "own.glb", "3D-FUTURE"])
def models(request, tmp_path):
    folder = tmp_path / "models"
    if request.param == "3D-FUTURE":
        write_sofa(folder / "a" / "raw_model.obj")
        row = {"model_id": "a", "category": "Three-seat / Multi-seat Sofa"}
        (folder / "model_info.json").write_text(json.dumps([row]))
    else:
        path = write_sofa(folder / "sofa" / "own.obj")
        if request.param == "own.glb":
            glb = trimesh.load_scene(path, process=False).export(file_type="glb")
            (folder / "sofa" / "own.glb").write_bytes(glb)
            path.unlink()
    return open_models(folder, "front3d_bedroom", tmp_path / "cache")


def retrieved(models) -> Scene:
    return retrieve(Scene("room", "front3d_bedroom", (SOFA, replace(SOFA, label="desk"))), models)


def test_a_glb_has_the_images_and_colours_of_the_model(models, tmp_path):
    scene = retrieved(models)
    write_scenes([scene], tmp_path / "out")
    glb = (tmp_path / "out" / "room.glb").read_bytes()
    (image,), told = images_of(glb), json_of(glb)
    np.testing.assert_array_equal(np.asarray(image), PIXELS)
    nodes = {node["name"]: node for node in told["nodes"]}
    children = [told["nodes"][row]["name"] for row in nodes["0_sofa"]["children"]]
    assert sorted(children) == ["0_sofa/0", "0_sofa/1"] and "mesh" in nodes["1_desk"]
    surfaces = [
        (told["materials"][part["material"]]["pbrMetallicRoughness"], part["attributes"])
        for child in children
        for part in told["meshes"][nodes[child]["mesh"]]["primitives"]
    ]
    (cloth,) = [has for look, has in surfaces if "baseColorTexture" in look]
    (red,) = [look for look, _ in surfaces if "baseColorTexture" not in look]
    assert "TEXCOORD_0" in cloth and red["baseColorFactor"][:3] == pytest.approx(RED)
    assert "texture" not in (tmp_path / "out" / "room.json").read_text()
    validate(tmp_path / "out" / "room.glb")


def test_meshes_of_textured_objects_are_closed_when_they_are_read(models, tmp_path):
    """Vertices are repeated along the seams of a texture, but colliders need closed meshes."""
    scene = retrieved(models)
    save(scene, tmp_path / "room.glb")
    save(scene, tmp_path / "room.json")
    for with_materials in (False, True):
        sofa = load_scene(tmp_path / "room.json", with_materials).objects[0]
        assert bool(sofa.textured) == with_materials
        assert len(closed_components(sofa.mesh)) == 2
    # Texture coordinates are those of the model.
    (seat,) = [part for part in sofa.textured if part.uv is not None]
    turn = quarter_rotation(scene.extra["retrieval"][0]["turn_deg"] // 90)
    unit = (seat.mesh.vertices_m - SOFA.center_m) / SOFA.size_m @ turn
    np.testing.assert_allclose(seat.uv, unit[:, [0, 2]] + 0.5, atol=1e-5)


def test_formats_of_glbs_keep_the_images_and_others_class_colours(models, tmp_path):
    scene = retrieved(models)
    for to in ("habitat", "sceneeval"):
        export_scenes([scene], to, tmp_path / to)
        images = [images_of(path.read_bytes()) for path in (tmp_path / to).rglob("*.glb")]
        assert sum(map(len, images)) == 1
    text, described = scene_to_obj(scene, "room.mtl")
    assert "map_Kd" not in described.decode() and "usemtl" in text


def test_models_without_materials_have_class_colours(tmp_path):
    path = write_sofa(tmp_path / "sofa" / "a.obj")
    named = path.read_text()
    for text in (named.replace("model.mtl", "lost.mtl"), named.replace("mtllib model.mtl", "")):
        path.write_text(text)
        assert read_textured(path) == ()


def test_materials_that_cannot_be_read_are_a_warning(tmp_path):
    path = write_sofa(tmp_path / "sofa" / "a.obj", Image.new("RGB", (99, 99), "red"))
    image = tmp_path / "sofa" / "texture.png"
    image.write_bytes(image.read_bytes()[:60])
    with pytest.warns(InputWarning, match=r"sofa/a\.obj gets the colour of its class, because its"):
        assert read_textured(path) == ()


@pytest.mark.parametrize("mode", ["P", "CMYK", "LA"])
def test_large_textures_are_scaled_down_and_written_as_png(mode, tmp_path):
    path = write_sofa(tmp_path / "sofa" / "a.obj")
    image = Image.new(mode, (2 * LARGEST_PX, LARGEST_PX))
    name = "texture.jpg" if mode == "CMYK" else "texture.png"
    image.save(tmp_path / "sofa" / name)
    (tmp_path / "sofa" / "model.mtl").write_text(f"newmtl cloth\nmap_Kd {name}\n")
    seat = next(part for part in read_textured(path) if part.uv is not None)
    found = seat.material.baseColorTexture
    assert found.size == (LARGEST_PX, LARGEST_PX // 2) and found.mode in ("L", "RGB", "RGBA")
