"""The package's own furniture: every class of the shipped priors, closed, its front at +z."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sceneprior
from sceneprior.apps.priors.packed import read_packed, shipped_priors
from sceneprior.apps.retrieval.cad_models import made_models
from sceneprior.apps.retrieval.retrieve import with_models
from sceneprior.core.scene import Mesh, Scene, SceneObject
from sceneprior.core.scene_json import scene_to_json
from sceneprior.furniture.catalog import furniture_classes, make_variants
from sceneprior.render.appearance import box_mesh


def closed(mesh: Mesh) -> bool:
    return trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False).is_watertight


@pytest.mark.parametrize("name", shipped_priors())
def test_every_class_of_a_shipped_prior_has_models(name):
    classes = read_packed(shipped_priors()[name]).said.classes
    assert all(made_models().of_class(label) for label in classes[1:])


@pytest.mark.parametrize("label", sorted(furniture_classes()))
def test_models_are_closed_fill_their_box_and_have_three_styles(label):
    models = made_models()
    of_class = models.of_class(label)
    shapes = set()
    for model_id, points in zip(of_class.model_ids, of_class.points, strict=True):
        mesh = models.load(model_id)
        assert closed(mesh), model_id
        np.testing.assert_allclose(mesh.vertices_m.min(axis=0), -0.5, atol=1e-12)
        np.testing.assert_allclose(mesh.vertices_m.max(axis=0), 0.5, atol=1e-12)
        assert np.abs(points).max() <= 0.5
        shapes.add(mesh.faces.tobytes())
        if label in ("armchair", "chair", "double_bed", "single_bed", "sofa"):
            # Points above the seat or the mattress lie behind its centre on average.
            assert np.mean(points[points[:, 1] > 0.3][:, 2]) < -0.1
    assert len(of_class.model_ids) == len(make_variants(0, label))
    assert len(shapes) >= 3


def test_a_class_without_tables_has_no_models():
    bathtub = SceneObject("bathtub", (0.0, 0.3, 0.0), (1.6, 0.6, 0.7))
    (made,) = with_models([Scene("room", "scannet", (bathtub,))])
    assert made.objects == (bathtub,) and made.extra["retrieval"] == [None]


def test_objects_given_with_a_mesh_keep_it():
    box = (0.0, 0.5, 0.0), (2.0, 1.0, 1.0)
    own = SceneObject("sofa", *box, box_mesh(*box))
    bare = replace(own, mesh=None)
    room = Scene("room", "front3d_living", (own, bare, own))
    (made,) = with_models([room], (own, bare))
    assert made.objects[0] == own
    for item, found in zip(made.objects[1:], made.extra["retrieval"][1:], strict=True):
        assert found["model_id"].startswith("sofa_") and closed(item.mesh)
    assert made.extra["retrieval"][0] is None


def test_sampled_rooms_get_models_in_their_boxes():
    prior = sceneprior.load("demo-bedroom")
    (plain,), (made,) = prior.sample(seed=1), prior.sample(seed=1, cad=True)
    assert [item.label for item in plain.objects] == [item.label for item in made.objects]
    for item, found in zip(made.objects, made.extra["retrieval"], strict=True):
        assert found["model_id"].startswith(item.label) and closed(item.mesh)
        low, high = item.mesh.vertices_m.min(axis=0), item.mesh.vertices_m.max(axis=0)
        np.testing.assert_allclose((low + high) / 2, item.center_m, atol=1e-9)
        np.testing.assert_allclose(high - low, item.size_m, atol=1e-9)
        assert np.rad2deg(item.turned.yaw_rad) % 360 == pytest.approx(found["turn_deg"])
    (again,) = prior.sample(seed=1, cad=True)
    assert scene_to_json(made) == scene_to_json(again)
