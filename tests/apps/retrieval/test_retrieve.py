"""Retrieval: three fixed rooms as before, the supplement's rules, the fast search and the slow."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from golden_values import assert_as_before
from model_folder import blocks, corner_sofa, write_models

from sceneprior.apps.retrieval import retrieve as module
from sceneprior.apps.retrieval.cad_models import (
    CadModels,
    ClassModels,
    made_models,
    open_models,
    unit_mesh,
)
from sceneprior.apps.retrieval.retrieve import (
    extruded,
    most_similar,
    placed,
    retrieval_report,
    retrieve,
    retrieve_all,
)
from sceneprior.core.boxes import quarter_rotation
from sceneprior.core.scene import Mesh, Scene, SceneObject, quarter_turned
from sceneprior.core.surfaces import surface_points

BED = ((0, 0.3, 0), (1.8, 0.6, 2)), ((0, 0.9, -0.95), (1.8, 0.6, 0.1))


def cad_models(points: int = 256, **of_classes) -> CadModels:
    """label -> {model id: trimesh}."""
    by_class, meshes = {}, {}
    for label, of_class in of_classes.items():
        units = [
            unit_mesh(Mesh(np.asarray(m.vertices), np.asarray(m.faces))) for m in of_class.values()
        ]
        meshes |= dict(zip(of_class, units, strict=True))
        drawn = [surface_points(unit.vertices_m, unit.faces, points) for unit in units]
        by_class[label] = ClassModels(tuple(of_class), np.stack(drawn).astype(np.float32))
    return CadModels(by_class.get, meshes.__getitem__)


@pytest.fixture(scope="module")
def models():
    plain = blocks(((0, 0.5, 0), (1, 1, 1)))
    table = blocks(((0, 0.7, 0), (1.2, 0.1, 0.8)), ((0.5, 0.35, 0), (0.1, 0.7, 0.7)))
    return cad_models(sofa={"plain": plain, "corner": corner_sofa(), "table": table})


def room(*objects: SceneObject) -> Scene:
    return Scene("room", "front3d_living", objects)


# -- Three fixed rooms ----------------------------------------------------------------------------


def meshed(label: str, center_m, size_m, mesh: trimesh.Trimesh, turns: int) -> SceneObject:
    """An object whose mesh is another one's, turned and stretched into its box."""
    points = np.asarray(mesh.vertices) @ quarter_rotation(turns).T
    low, high = points.min(axis=0), points.max(axis=0)
    points = (points - (low + high) / 2) / (high - low) * size_m + center_m
    return SceneObject(label, center_m, size_m, Mesh(points, np.asarray(mesh.faces)))


@pytest.fixture(scope="module")
def rooms() -> list[Scene]:
    """Boxes alone, meshes, and known yaws."""
    back = blocks(((0, 0.3, 0), (1, 0.6, 1)), ((0, 0.8, -0.4), (1, 0.4, 0.2)))
    boxes = (
        SceneObject("double_bed", (0.2, 0.4, -1.0), (1.8, 0.8, 2.1)),
        SceneObject("nightstand", (1.4, 0.3, -1.7), (0.5, 0.6, 0.4)),
        SceneObject("pendant_lamp", (0.0, 2.2, 0.0), (0.5, 0.6, 0.5)),
        SceneObject("wardrobe", (-1.6, 1.05, 0.5), (0.6, 2.1, 1.6)),
    )
    meshes = (
        meshed("sofa", (0.0, 0.45, -1.5), (2.2, 0.9, 1.6), corner_sofa(), 1),
        meshed("armchair", (1.5, 0.5, 0.0), (0.8, 0.9, 0.9), back, 3),
        meshed("chair", (-1.5, 0.5, 0.0), (0.5, 0.9, 0.5), back, 2),
    )
    size = (0.5, 0.9, 0.5)
    yaws = tuple(
        SceneObject("chair", (k - 1.5, 0.45, 1.0), size, turned=quarter_turned(size, k))
        for k in range(4)
    )
    return [
        Scene("boxes", "front3d_bedroom", boxes),
        Scene("meshes", "front3d_living", meshes),
        Scene("yaws", "front3d_bedroom", yaws),
    ]


def told(scene: Scene) -> list:
    return [
        [item.label, found, item.center_m, item.size_m, item.turned and item.turned.yaw_rad,
         None if item.mesh is None else np.abs(item.mesh.vertices_m).mean()]
        for item, found in zip(scene.objects, scene.extra["retrieval"], strict=True)
    ]  # fmt: skip


def test_the_packages_own_models(rooms):
    found = list(retrieve_all(rooms, made_models()))
    assert_as_before("apps/retrieved_made", [told(scene) for scene in found], abs=2e-5)
    assert_as_before("apps/retrieval_report", retrieval_report(found, made_models()), abs=2e-5)
    kept = retrieve(rooms[1], made_models(), keep=[0])
    assert kept.objects[0] == rooms[1].objects[0] and kept.extra["retrieval"][0] is None


def test_models_of_a_folder(rooms, tmp_path):
    shapes = {
        "plain": ("Three-seat / Multi-seat Sofa", blocks(((0, 0.5, 0), (1, 1, 1)))),
        "corner": ("L-shaped Sofa", corner_sofa()),
        "bed": ("King-size Bed", blocks(*BED)),
        "low": ("King-size Bed", blocks(((0, 0.3, 0), (1.8, 0.6, 2)))),
    }  # fmt: skip
    folder = write_models(tmp_path / "models", shapes)
    found = []
    for scene in rooms[:2]:
        models = open_models(folder, scene.label_set, tmp_path / "cache")
        found.append(told(retrieve(scene, models)))
    assert_as_before("apps/retrieved_folder", found, abs=2e-5)


# -- Rules -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("center_y", "height", "wanted"),
    [
        (1.0, 0.4, (0.6, 1.2)),  # exactly 1 m: down to the floor, the top stays
        (1.001, 0.4, (1.001, 0.4)),
        (0.3, 0.6, (0.3, 0.6)),  # stands already
        (0.2, 0.6, (0.25, 0.5)),  # came from below the floor
        (-1.0, 0.5, (-1.0, 0.5)),  # all of it is below: nothing to stand on
    ],
)
def test_low_boxes_are_extruded_to_the_floor(center_y, height, wanted):
    item = extruded(SceneObject("sofa", (1.0, center_y, 2.0), (0.5, height, 0.7)))
    assert (item.center_m[1], item.size_m[1]) == pytest.approx(wanted)
    assert (item.center_m[0], item.center_m[2], *item.size_m[::2]) == (1.0, 2.0, 0.5, 0.7)


@pytest.mark.parametrize("turn", [0, 90, 180, 270])
@pytest.mark.parametrize("size", [(2.0, 0.8, 1.2), (0.7, 1.9, 1.5)])
def test_a_model_in_disguise_is_found_with_its_turn(models, turn, size):
    """The corner sofa itself, turned and stretched into a box, has distance nearly 0."""
    item = SceneObject("sofa", (1.0, size[1] / 2, -2.0), size)
    mesh = placed(models.load("corner"), item, turn)
    np.testing.assert_allclose(
        mesh.vertices_m.min(0), np.subtract(item.center_m, np.divide(size, 2))
    )
    np.testing.assert_allclose(mesh.vertices_m.max(0), np.add(item.center_m, np.divide(size, 2)))
    best = most_similar(replace(item, mesh=mesh), models.of_class("sofa"))
    assert (best.model_id, best.turn_deg) == ("corner", turn)
    assert best.distance_m < 0.15  # two samples of one surface
    made = retrieve(room(replace(item, mesh=mesh)), models)
    np.testing.assert_allclose(made.objects[0].mesh.vertices_m, mesh.vertices_m)


def random_furniture(rng):
    """Two to five blocks on one another: many pieces, some much alike."""
    parts = []
    for _ in range(rng.integers(2, 6)):
        size = rng.uniform(0.1, 1.0, 3)
        parts.append((tuple(rng.uniform(-0.5, 0.5, 3)), tuple(size)))
    return blocks(*parts)


def test_the_fast_search_finds_the_winner_of_the_slow_one(rng, monkeypatch):
    models = cad_models(1024, sofa={f"m{k:02d}": random_furniture(rng) for k in range(40)})
    for _ in range(2):
        size = tuple(rng.uniform(0.4, 2.2, 3))
        like = random_furniture(rng)
        item = SceneObject("sofa", (0.0, size[1] / 2, 0.0), size)
        unit = unit_mesh(Mesh(np.asarray(like.vertices), np.asarray(like.faces)))
        item = replace(item, mesh=placed(unit, item, 0))
        fast = most_similar(item, models.of_class("sofa"))
        with monkeypatch.context() as patch:
            patch.setattr(module, "ROUNDS", ())  # all are compared by all points
            assert most_similar(item, models.of_class("sofa")) == fast


def test_a_mesh_without_a_model_stays_in_step_with_its_box(models):
    """A plant above the floor, whose class has no model, grows down to it with its box."""
    low, high = np.array([1.0, 0.3, 0.0]), np.array([1.6, 1.1, 0.4])
    center, size = (low + high) / 2, high - low
    vertices = np.vstack([low, high, [1.1, 0.5, 0.2]])
    plant = SceneObject("plant", tuple(center), tuple(size), Mesh(vertices, np.array([(0, 1, 2)])))
    made = retrieve(room(plant), models)
    (item,) = made.objects
    assert item.center_m == pytest.approx((1.3, 0.55, 0.2))
    assert item.size_m == pytest.approx((0.6, 1.1, 0.4))
    report = retrieval_report([made], replace(models, broken={"x": "gone"}))
    assert report["classes_without_models"] == ["plant"] and report["broken_models"] == {
        "x": "gone"
    }
    assert (report["objects"], report["objects_with_a_model"]) == (1, 0)
    assert report["classes"]["plant"]["mean_distance_m"] is None
    grown = vertices * (1, 1.1 / 0.8, 1) - (0, 0.3 * 1.1 / 0.8, 0)
    np.testing.assert_allclose(item.mesh.vertices_m, grown, atol=1e-12)


@pytest.mark.parametrize("center_y", [0.4, 0.6, 1.5])
def test_objects_without_a_model_keep_their_yaw(models, center_y):
    """A plant that stands, one that grows down to the floor, and one that hangs."""
    turned = quarter_turned((0.6, 0.8, 0.4), 1)
    plant = SceneObject("plant", (1.0, center_y, 0.0), (0.6, 0.8, 0.4), turned=turned)
    (item,) = retrieve(room(plant), models).objects
    width, _, depth = turned.size_m
    assert item.turned == turned._replace(size_m=(width, item.size_m[1], depth))


def test_objects_that_are_kept_keep_their_entry(models):
    sofas = [SceneObject("sofa", (3.0 * k, 0.4, 0.0), (2.0, 0.8, 1.2)) for k in range(2)]
    before = {"model_id": "of before", "turn_deg": 90, "distance_m": 0.5}
    given = replace(room(*sofas), extra={"retrieval": [before, None]})
    first, second = retrieve(given, models, keep=[0]).extra["retrieval"]
    assert first == before and second["model_id"] == "plain"
    assert retrieve(given, models, keep=[1]).extra["retrieval"][1] is None  # it had no entry
    for other in (None, 5, {"a": 1}, [before]):  # of a file that others wrote
        odd = retrieve(replace(given, extra={"retrieval": other}), models, keep=[0])
        assert odd.extra["retrieval"][0] is None


def test_rooms_without_objects_and_objects_without_volume_have_defined_answers(models):
    assert retrieve(room(), models).extra["retrieval"] == []
    flat = SceneObject("sofa", (0.0, 0.0, 0.0), (1.0, 0.0, 1.0))
    point = SceneObject("sofa", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    collapsed = SceneObject(
        "sofa", (0.0, 0.5, 0.0), (1.0, 1.0, 1.0), Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    )
    made = retrieve(room(flat, point, collapsed), models)
    assert all(np.isfinite(found["distance_m"]) for found in made.extra["retrieval"])
    assert made.extra["retrieval"][2]["model_id"] == "plain"  # by its box


def test_models_keep_a_known_yaw():
    """A cupboard whose doors stand out by 1 cm, decoded as a box."""
    cupboard = blocks(((0, 0.5, 0), (1, 1, 0.5)), ((0, 0.5, 0.255), (0.9, 0.9, 0.01)))
    models = cad_models(wardrobe={"cupboard": cupboard})
    size = (1.0, 1.0, 1.0)
    # Other triangles than the models', so that no points coincide.
    plain = trimesh.creation.box(size).subdivide().apply_translation([0, 0.5, 0])
    box = SceneObject("wardrobe", (0.0, 0.5, 0.0), size, Mesh(plain.vertices, plain.faces))
    for quarters in range(4):
        item = replace(box, turned=quarter_turned(size, quarters))
        (made,) = retrieve(room(item), models).objects
        assert made.turned == item.turned
        # Even if the mesh is that of a cupboard which faces backwards.
        mesh = placed(models.load("cupboard"), item, 90 * (quarters + 2) % 360)
        (made,) = retrieve(room(replace(item, mesh=mesh)), models).objects
        assert made.turned == item.turned


def test_objects_of_similar_sizes_get_one_model_if_asked_for(rng):
    sofas = {f"m{row}": random_furniture(rng) for row in range(6)}
    models = cad_models(1024, sofa=sofas)
    items = []
    for row, size in enumerate(
        [(1.0, 0.8, 0.6), (0.7, 0.8, 1.1), (1.9, 0.8, 0.6), (0.6, 0.8, 1.0)]
    ):
        item = SceneObject("sofa", (3.0 * row, 0.4, 0.0), size)
        mesh = placed(models.load(f"m{row}"), item, 90 * (row == 1))
        # The second one is turned by a quarter; the last one has the first's sides, exchanged.
        items.append(replace(item, mesh=mesh, turned=quarter_turned(size, row == 1)))
    for alike, wanted in ((False, ["m0", "m1", "m2", "m3"]), (True, ["m0", "m0", "m2", "m3"])):
        told = retrieve(room(*items), models, alike=alike).extra["retrieval"]
        assert [each["model_id"] for each in told] == wanted
