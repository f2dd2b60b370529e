"""Three fixed rooms have the same CAD models, in the same poses, as before."""

import numpy as np
import pytest
import trimesh
from golden_values import assert_as_before
from model_folder import blocks, corner_sofa, write_models

from sceneprior.apps.retrieval.cad_models import made_models, open_models
from sceneprior.apps.retrieval.retrieve import retrieval_report, retrieve, retrieve_all
from sceneprior.core.boxes import quarter_rotation
from sceneprior.core.scene import Mesh, Scene, SceneObject, quarter_turned

BED = ((0, 0.3, 0), (1.8, 0.6, 2)), ((0, 0.9, -0.95), (1.8, 0.6, 0.1))


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
    yaws = tuple(
        SceneObject(
            "chair",
            (k - 1.5, 0.45, 1.0),
            (0.5, 0.9, 0.5),
            turned=quarter_turned((0.5, 0.9, 0.5), k),
        )
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
