"""Rooms for simulators, each format read by its own library."""

from xml.etree import ElementTree

import numpy as np
import pytest
from rooms_of_solids import solid_box

from sceneprior.core.masses import mass_kg
from sceneprior.core.scene import Opening, Scene, SceneObject, Solid
from sceneprior.interchange.export import export_scenes
from sceneprior.render.scene_files import save_scene

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


def numbers(element: ElementTree.Element, name: str) -> list[float]:
    return [float(number) for number in element.get(name).split()]


def test_mujoco_gets_primitives_that_stand(tmp_path):
    """A box, a round cylinder and a dome; the oval cylinder is a mesh."""
    solids = (
        Solid("box", (-0.5, 0.7, -0.5), (0.5, 0.8, 0.5)),
        Solid("cylinder", (-0.5, 0.1, -0.5), (-0.4, 0.7, -0.4)),
        Solid("cylinder", (0.3, 0.1, -0.5), (0.5, 0.7, 0.5)),
        Solid("dome", (-0.2, 0.8, -0.2), (0.2, 1.0, 0.2)),
    )
    table = SceneObject("table", (0.0, 0.55, 0.0), (1.0, 0.9, 1.0), solids=solids)
    lamp = SceneObject("pendant_lamp", (1.0, 2.2, -0.5), (0.3, 0.4, 0.2))
    (note,) = export_scenes([Scene("one", BEDROOM, (table, lamp))], "mujoco", tmp_path)
    assert note.endswith("of 2 objects: 1 set down.")
    root = ElementTree.parse(tmp_path / "one.xml").getroot()
    first, second = root.findall(".//body")
    assert (first.get("name"), second.get("name")) == ("0_table", "1_pendant_lamp")
    assert first.find("freejoint") is not None and second.find("freejoint") is None
    geoms = first.findall("geom")
    assert [geom.get("type") for geom in geoms] == ["box", "cylinder", "mesh", "mesh"]
    np.testing.assert_allclose(numbers(first, "pos"), (0, 0, 0.45))
    np.testing.assert_allclose(numbers(geoms[1], "size"), (0.05, 0.3))
    np.testing.assert_allclose(numbers(geoms[1], "pos"), (-0.45, 0.45, -0.15))
    total = sum(float(geom.get("mass")) for geom in geoms)
    assert total == pytest.approx(mass_kg(table), rel=1e-3)


def test_mujoco_loads_a_room_with_walls_in_which_nothing_overlaps(scene, tmp_path):
    mujoco = pytest.importorskip("mujoco", reason="no mujoco here: pip install -e '.[sim]'")
    assert export_scenes([scene], "mujoco", tmp_path) == [
        "So that nothing falls over or overlaps, of 3 objects: 1 set down.",
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


def test_usd_holds_meshes_in_metres_with_y_up(scene, tmp_path):
    geometry = pytest.importorskip("pxr.UsdGeom")
    save_scene(scene, tmp_path / "room.usda", shell="floor")
    stage = pytest.importorskip("pxr.Usd").Stage.Open(str(tmp_path / "room.usda"))
    assert geometry.GetStageUpAxis(stage) == "Y" and geometry.GetStageMetersPerUnit(stage) == 1.0
    *objects, floor = stage.GetDefaultPrim().GetChildren()
    assert floor.GetName() == "floor"
    for prim, item in zip(objects, scene.objects, strict=True):
        assert prim.GetAttribute("userProperties:class").Get() == item.label
        (shape,) = prim.GetChildren()
        points = np.array(geometry.Mesh(shape).GetPointsAttr().Get())
        placed = points + geometry.Xformable(prim).GetLocalTransformation().ExtractTranslation()
        low, high = placed.min(axis=0), placed.max(axis=0)
        np.testing.assert_allclose((low + high) / 2, item.center_m, atol=1e-6)
        np.testing.assert_allclose(high - low, item.size_m, atol=1e-6)
        assert not prim.GetAppliedSchemas()


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
