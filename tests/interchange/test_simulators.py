"""Rooms for simulators, each format read by its own library."""

import json
from dataclasses import replace

import numpy as np
import pytest
import shapely
import trimesh
from gltf import json_of
from rooms_of_solids import solid_box

from sceneprior.core.boxes import yaw_rotation
from sceneprior.core.colliders import colliders, mass_kg, mesh_of
from sceneprior.core.scene import Mesh, Opening, Scene, SceneObject, Solid, Turned, bound_m
from sceneprior.interchange.export import export_scenes

BEDROOM = "front3d_bedroom"
L = np.array([[-2.5, -2], [2.5, -2], [2.5, 0.5], [0.5, 0.5], [0.5, 2.2], [-2.5, 2.2]])
DOOR = Opening("door", (1.0, -2.0), (1.9, -2.0), 0.0, 2.0)


@pytest.fixture
def scene() -> Scene:
    """A bed, a floating desk that reaches through a wall, and a lamp."""
    objects = (
        solid_box("double_bed", (-1.2, 0.3, -0.9), (1.8, 0.6, 2.0)),
        solid_box("desk", (2.3, 0.45, -0.6), (1.0, 0.8, 0.6)),
        solid_box("pendant_lamp", (1.0, 2.2, -0.5), (0.3, 0.4, 0.2)),
    )
    return Scene("room", BEDROOM, objects, L, openings=(DOOR,))


def test_mujoco_loads_a_room_with_walls_in_which_nothing_overlaps(scene, tmp_path):
    mujoco = pytest.importorskip("mujoco", reason="no mujoco here: pip install -e '.[sim]'")
    notes = export_scenes([scene], "mujoco", tmp_path)
    assert notes.left_out == [] and notes.changed == [
        "Changed so that nothing falls over or overlaps: 1 set down (of 3 objects).",
        "Walls of 1 rooms stand further out than floor_m, by up to 0.30 m, because furniture "
        "stands there.",
    ]
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "room.xml"))
    assert model.nbody == 1 + 3 and model.njnt == 2
    assert model.body("0_double_bed").mass[0] == pytest.approx(mass_kg(scene.objects[0]))
    state = mujoco.MjData(model)
    mujoco.mj_forward(model, state)
    assert min(contact.dist for contact in state.contact) > -1e-5  # digits in the file
    # The door's wall has a box on either side of it, and one above.
    walls = [name for row in range(model.ngeom) if (name := model.geom(row).name)[:4] == "wall"]
    assert len(walls) == 6 + 2
    # Through the door one sees out, and beside it the wall.
    for x, expected in ((1.45, -1.0), (0.5, 1.0)):
        eye, north = np.array([x, 1.0, 1.0]), np.array([0.0, 1.0, 0.0])
        hit = mujoco.mj_ray(model, state, eye, north, None, 1, -1, np.zeros(1, np.int32))
        assert hit == pytest.approx(expected)


def test_mujoco_loads_panes_and_crumbs(tmp_path):
    """A mesh without volume, at an angle and lying, and a box that weighs less than a gram."""
    mujoco = pytest.importorskip("mujoco", reason="no mujoco here: pip install -e '.[sim]'")
    plane = trimesh.creation.box((0.4, 0.4, 0.4)).vertices * (1, 1, 0)
    plane = plane @ yaw_rotation(0.5).T + (0, 0.2, 0)
    mesh = Mesh(plane, trimesh.creation.box().faces)
    pane = SceneObject("shelf", (0.0, 0.2, 0.0), tuple(np.ptp(plane, axis=0)), mesh)
    crumb = solid_box("stool", (1.0, 0.005, 0.0), (0.01, 0.01, 0.01))
    export_scenes([Scene("room", BEDROOM, (pane, crumb))], "mujoco", tmp_path)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "room.xml"))
    assert model.nbody == 1 + 2 and (model.body_mass[1:] > 0).all()


def test_usd_of_simulators_has_bodies_and_passes_every_check(scene, tmp_path):
    physics = pytest.importorskip("pxr.UsdPhysics")
    validation = pytest.importorskip("pxr.UsdValidation")
    round_ = Solid("cylinder", (-0.2, 0.0, 0.8), (0.2, 0.4, 1.2))
    dome = Solid("dome", (-0.2, 0.4, 0.8), (0.2, 0.5, 1.2))
    stool = SceneObject("stool", (0.0, 0.25, 1.0), (0.4, 0.5, 0.4), solids=(round_, dome))
    more = Scene("room", BEDROOM, (*scene.objects, stool), L, openings=(DOOR,))
    export_scenes([more], "usd", tmp_path)
    stage = pytest.importorskip("pxr.Usd").Stage.Open(str(tmp_path / "room.usda"))
    context = validation.ValidationContext(validation.ValidationRegistry().GetOrLoadAllValidators())
    assert [error.GetMessage() for error in context.Validate(stage)] == []
    rigid = [prim for prim in stage.Traverse() if prim.HasAPI(physics.RigidBodyAPI)]
    names = ["object_0_double_bed", "object_1_desk", "object_3_stool"]
    assert [prim.GetName() for prim in rigid] == names
    mass = physics.MassAPI(rigid[0]).GetMassAttr().Get()
    assert mass == pytest.approx(mass_kg(scene.objects[0]))
    colliders = [prim for prim in rigid[2].GetChildren() if prim.HasAPI(physics.CollisionAPI)]
    assert [prim.GetTypeName() for prim in colliders] == ["Cylinder", "Mesh"]
    walls = [prim for prim in stage.Traverse() if prim.GetName().startswith("wall_")]
    assert len(walls) == 6 and all(prim.HasAPI(physics.CollisionAPI) for prim in walls)


def test_habitat_gets_a_dataset_whose_files_are_all_there(scene, tmp_path):
    """Every template is a config, every asset a GLB; transforms put assets where objects are."""
    turned = Turned(np.pi / 4, (1.0, 0.5, 0.2))
    bench = SceneObject("stool", (0.0, 0.25, 1.5), bound_m(turned), turned=turned)
    bench = replace(bench, mesh=mesh_of(colliders(bench)[0]))
    more = replace(scene, objects=(*scene.objects, bench))
    export_scenes([more], "habitat", tmp_path)
    dataset = json.loads((tmp_path / "rooms.scene_dataset_config.json").read_text())
    assert dataset["scene_instances"]["paths"] == {".json": ["scenes"]}
    room = json.loads((tmp_path / "scenes" / "room.scene_instance.json").read_text())
    stage = f"{room['stage_instance']['template_name']}.stage_config.json"
    config = json.loads((tmp_path / stage).read_text())
    named = trimesh.load_scene(tmp_path / "stages" / config["render_asset"])
    assert {"floor", "wall_0", "ceiling"} <= set(named.graph.nodes_geometry)
    # Standing moved the desk down by 5 cm.
    centers = [(-1.2, 0.3, -0.9), (2.3, 0.4, -0.6), (1.0, 2.2, -0.5), (0.0, 0.25, 1.5)]
    for entry, item, center in zip(room["object_instances"], more.objects, centers, strict=True):
        path = tmp_path / f"{entry['template_name']}.object_config.json"
        config = json.loads(path.read_text())
        assert config["mass"] == mass_kg(item) and config["front"] == [0, 0, -1]
        for asset in ("render_asset", "collision_asset"):
            mesh = trimesh.load_scene(path.parent / config[asset]).to_geometry()
            place = trimesh.transformations.quaternion_matrix(entry["rotation"])
            place[:3, 3] = entry["translation"]
            placed = mesh.apply_transform(place)
            np.testing.assert_allclose(placed.bounds.mean(axis=0), center, atol=1e-5)
            np.testing.assert_allclose(placed.extents, item.size_m, atol=1e-5)
    kinds = [entry["motion_type"] for entry in room["object_instances"]]
    assert kinds == ["DYNAMIC", "DYNAMIC", "STATIC", "DYNAMIC"]
    # The turned bench is straight in its own frame, and does not say that it is turned there.
    path = tmp_path / "objects" / "room_3_stool.glb"
    np.testing.assert_allclose(trimesh.load_scene(path).extents, turned.size_m, atol=1e-5)
    (told,) = json_of(path.read_bytes())["scenes"][0]["extras"]["sceneprior"]["objects"]
    assert told == {"node": "0_stool", "class": "stool"}


def test_sceneeval_gets_a_scene_state_with_z_up(scene, tmp_path):
    export_scenes([scene], "sceneeval", tmp_path)
    state = json.loads((tmp_path / "scene_0.json").read_text())
    assert (state["format"], state["scene"]["version"]) == ("sceneState", "scene@1.0.2")
    for entry, item in zip(state["scene"]["object"], scene.objects, strict=True):
        model = entry["modelId"].removeprefix("sceneprior.")
        asset = tmp_path / "assets" / model
        about = json.loads((asset / "data.json").read_text())["annotations"]
        assert about["category"] == item.label
        matrix = np.array(entry["transform"]["data"]).reshape(4, 4).T
        placed = trimesh.load_scene(asset / f"{model}.glb").to_geometry().apply_transform(matrix)
        x, y, z = item.center_m
        np.testing.assert_allclose(placed.bounds.mean(axis=0), (x, -z, y), atol=1e-6)
        np.testing.assert_allclose(placed.extents, np.array(item.size_m)[[0, 2, 1]], atol=1e-6)
    floor, *walls = state["scene"]["arch"]["elements"]
    outline = shapely.Polygon([(x, y) for x, y, _ in floor["points"]])
    assert outline.exterior.is_ccw and len(walls) == 6
    (wall,) = (wall for wall in walls if wall["holes"])
    (hole,) = wall["holes"]
    start, end = np.array(wall["points"])[:, :2]
    along = (end - start) / np.linalg.norm(end - start)
    # The door's ends, counted from the wall's first point, are where the room has them.
    ends = sorted((start + along * hole["box"][side][0]).tolist() for side in ("min", "max"))
    np.testing.assert_allclose(ends, [[1.0, 2.0], [1.9, 2.0]], atol=1e-9)
    assert (hole["type"], hole["box"]["max"][1]) == ("Door", 2.0)
