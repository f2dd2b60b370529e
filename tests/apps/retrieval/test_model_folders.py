"""A user's own models: GLBs and OBJs in sub-folders by class, and sentences on those left out."""

import numpy as np
import pytest
import trimesh
from model_folder import blocks, corner_sofa

from sceneprior.apps.retrieval.cad_models import open_models
from sceneprior.apps.retrieval.model_folders import class_of_folder, read_glb
from sceneprior.core.errors import InputError, InputWarning


@pytest.fixture
def folder(tmp_path):
    """Two sofas, one a GLB of two placed nodes, a bed by its category, and a bathtub."""
    home = tmp_path / "mine"
    for name in ("sofa", "King-Size Bed", "bathtub"):
        (home / name).mkdir(parents=True)
    corner_sofa().export(home / "sofa" / "corner.obj")
    scene = trimesh.Scene()
    scene.add_geometry(blocks(((0, 0.2, 0), (2, 0.4, 0.8))), node_name="seat")
    raised = np.eye(4)
    raised[1, 3] = 0.4
    scene.add_geometry(blocks(((0, 0.2, -0.3), (2, 0.4, 0.2))), node_name="back", transform=raised)
    (home / "sofa" / "plain.GLB").write_bytes(scene.export(file_type="glb"))
    blocks(((0, 0.3, 0), (1.8, 0.6, 2))).export(home / "King-Size Bed" / "bed.obj")
    blocks(((0, 0.3, 0), (1.8, 0.6, 0.8))).export(home / "bathtub" / "tub.obj")
    return home


def opened(folder, label_set="front3d_bedroom"):
    return open_models(folder, label_set, folder.parent / "cache", 32)


def test_folders_are_classes_or_categories(folder, recwarn):
    models = opened(folder)
    assert {label: some.model_ids for label, some in models.by_class.items()} == {
        "double_bed": ("King-Size Bed/bed.obj",),
        "sofa": ("sofa/corner.obj", "sofa/plain.GLB"),
    }
    assert not models.broken
    assert not [each for each in recwarn if issubclass(each.category, InputWarning)]
    np.testing.assert_allclose(np.ptp(models.load("sofa/plain.GLB").vertices_m, axis=0), 1)
    mesh = read_glb(folder / "sofa" / "plain.GLB")
    assert mesh.vertices_m[:, 1].max() == pytest.approx(0.8)  # nodes are placed
    again = opened(folder)
    np.testing.assert_array_equal(again.by_class["sofa"].points, models.by_class["sofa"].points)


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("tv_stand", "tv_stand"),
        ("TV Stand", "tv_stand"),
        ("bookcase_jewelry armoire", "bookshelf"),
        ("barstool", "void"),
        ("toilet", "void"),
        ("spaceship", None),
    ],
)
def test_names_of_folders(name, label):
    assert class_of_folder(name, "front3d_bedroom") == label
    assert class_of_folder("spaceship", "void,spaceship") == "spaceship"


def test_unknown_names_and_damaged_files_are_a_sentence_each(folder):
    (folder / "sofaa").mkdir()
    corner_sofa().export(folder / "sofaa" / "one.obj")
    (folder / "sofa" / "cut.glb").write_bytes((folder / "sofa" / "plain.GLB").read_bytes()[:300])
    (folder / "sofa" / "none.obj").write_text("v 0 0 0\n")
    with pytest.warns(InputWarning) as told:
        models = opened(folder)
    (said,) = [str(each.message) for each in told if issubclass(each.category, InputWarning)]
    assert said.startswith(f"{folder / 'sofaa'} is left out, with 1 models: its name is neither")
    assert set(models.broken) == {"sofa/cut.glb", "sofa/none.obj"}
    assert models.broken["sofa/cut.glb"].startswith("sofa/cut.glb cannot be read (")
    assert models.broken["sofa/none.obj"] == "sofa/none.obj holds no usable triangles"
    assert "\n" not in models.broken["sofa/cut.glb"]


def test_a_folder_without_classes_or_models_is_a_sentence(folder, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"has no model_info.json .* nor a sub-folder of a class"):
        opened(tmp_path / "empty")
    with pytest.raises(InputError, match="holds no usable model of a class of void,spaceship"):
        opened(folder, "void,spaceship")
