"""CAD models: of folders, which are broken, points that are sampled once; the package's own."""

import numpy as np
import pytest
import trimesh
from model_folder import blocks, corner_sofa, write_model, write_models
from refusals import refused

from sceneprior.apps.priors.packed import read_packed, shipped_priors
from sceneprior.apps.retrieval import cad_models
from sceneprior.apps.retrieval.cad_models import POINTS, made_models, open_models, read_glb
from sceneprior.apps.retrieval.retrieve import with_models
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputWarning
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.furniture.catalog import furniture_classes, make_variants

BED = blocks(((0, 0.3, 0), (1.8, 0.6, 2.0)), ((0, 0.6, -0.95), (1.8, 1.2, 0.1)))


@pytest.fixture
def folder(tmp_path):
    """3D-FUTURE's layout: two beds, one a hundred times too large, a flat table, a toy, and four
    broken models."""
    huge = BED.copy()
    huge.apply_scale(100)
    flat = trimesh.Trimesh([[0, 0, 0], [2, 0, 0], [2, 0, 1], [0, 0, 1]], [[0, 1, 2], [0, 2, 3]])
    kinds = {"bed": ("King-size Bed", BED), "huge": ("King-size Bed", huge)}
    kinds |= {"flat": ("Dining Table", flat), "toy": ("Toy", BED)}
    kinds |= dict.fromkeys(("nan", "faceless", "missing", "point"), ("Nightstand", BED))
    made = write_models(tmp_path / "models", kinds)
    (made / "nan" / "raw_model.obj").write_text("v 0 0 0\nv nan 1 0\nv 1 0 0\nf 1 2 3\n")
    (made / "faceless" / "raw_model.obj").write_text("v 0 0 0\n")
    (made / "point" / "raw_model.obj").write_text("v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n")
    (made / "missing" / "raw_model.obj").unlink()
    return made


@pytest.fixture
def own(tmp_path):
    """The user's layout: two sofas, one a GLB of two placed nodes, a bed by its category, and a
    bathtub."""
    home = tmp_path / "mine"
    for name in ("sofa", "King-Size Bed", "bathtub"):
        (home / name).mkdir(parents=True)
    corner_sofa().export(home / "sofa" / "corner.obj")
    scene = trimesh.Scene()
    scene.add_geometry(blocks(((0, 0.2, 0), (2, 0.4, 0.8))), node_name="seat")
    raised = trimesh.transformations.translation_matrix((0, 0.4, 0))
    scene.add_geometry(blocks(((0, 0.2, -0.3), (2, 0.4, 0.2))), node_name="back", transform=raised)
    (home / "sofa" / "plain.GLB").write_bytes(scene.export(file_type="glb"))
    BED.export(home / "King-Size Bed" / "bed.obj")
    BED.export(home / "bathtub" / "tub.obj")
    return home


@pytest.fixture
def read(monkeypatch):
    """Names of the folders whose OBJ was read."""
    reads = []
    read_obj = cad_models.read_obj
    monkeypatch.setattr(
        cad_models, "read_obj", lambda path: reads.append(path.parent.name) or read_obj(path)
    )
    return reads


def opened(folder, label_set_name="front3d_bedroom"):
    return open_models(folder, label_set_name, folder.parent / "cache")


def ids_of(models):
    found = {label: models.of_class(label) for label in label_set("front3d_bedroom")}
    return {label: some.model_ids for label, some in found.items() if some}


def test_models_by_class_and_broken_models(folder):
    info = folder / "model_info.json"
    info.write_text(info.read_text()[:-1] + ', {"model_id": "../x", "category": "Dining Table"}]')
    models = opened(folder)
    assert ids_of(models) == {"double_bed": ("bed", "huge"), "table": ("flat",)}
    assert set(models.broken) == {"nan", "faceless", "missing", "point", "../x"}
    assert "no usable triangles" in models.broken["nan"] and "no area" in models.broken["point"]
    assert "cannot be read" in models.broken["missing"]
    assert "cannot be a folder's name" in models.broken["../x"]
    beds = models.of_class("double_bed").points
    assert beds.shape == (2, POINTS, 3) and np.abs(beds).max() <= 0.5
    # A hundred times too large is the same model in its unit box.
    np.testing.assert_allclose(beds[0], beds[1], atol=1e-6)
    assert (models.of_class("table").points[..., 1] == 0).all()  # flat stays flat
    np.testing.assert_allclose(np.ptp(models.load("huge").vertices_m, axis=0), 1)


def test_points_are_sampled_once_and_again_where_a_file_changed(folder, read):
    first = opened(folder).of_class("double_bed").points
    assert sorted(read) == ["bed", "faceless", "flat", "huge", "nan", "point"]
    read.clear()
    np.testing.assert_array_equal(first, opened(folder).of_class("double_bed").points)
    assert sorted(read) == ["faceless", "nan", "point"]  # broken ones may have been mended
    read.clear()
    write_model(folder, "bed", corner_sofa())
    beds = opened(folder).of_class("double_bed").points
    assert "bed" in read and "huge" not in read
    assert np.abs(beds[0] - first[0]).max() > 0.05
    np.testing.assert_array_equal(beds[1], first[1])
    (path,) = (folder.parent / "cache").iterdir()
    path.write_bytes(path.read_bytes()[:100])
    np.testing.assert_array_equal(beds, opened(folder).of_class("double_bed").points)


def test_points_for_one_label_set_stay_when_another_is_opened(folder, read):
    opened(folder, "void,double_bed")
    opened(folder, "void,table")
    assert sorted(read) == ["bed", "flat", "huge"]
    write_model(folder, "huge", corner_sofa())
    read.clear()
    opened(folder, "void,table")
    opened(folder, "void,double_bed")
    assert read == ["huge"]


def test_points_sampled_before_an_interrupt_are_kept(folder, read, monkeypatch):
    def stop_after_two(ids, *_, **__):
        yield from ids[:2]
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(cad_models, "track", stop_after_two)
        opened(folder)
    done = set(read) - {"nan", "faceless", "point"}
    read.clear()
    opened(folder)
    assert done and not set(read) & done


def test_own_folders_are_classes_or_categories(own, recwarn):
    models = opened(own)
    assert ids_of(models) == {
        "double_bed": ("King-Size Bed/bed.obj",),
        "sofa": ("sofa/corner.obj", "sofa/plain.GLB"),
    }
    assert not models.broken and not [w for w in recwarn if issubclass(w.category, InputWarning)]
    np.testing.assert_allclose(np.ptp(models.load("sofa/plain.GLB").vertices_m, axis=0), 1)
    mesh = read_glb(own / "sofa" / "plain.GLB")
    assert mesh.vertices_m[:, 1].max() == pytest.approx(0.8)  # nodes are placed


def test_unknown_names_and_damaged_files_are_a_sentence_each(own):
    (own / "sofaa").mkdir()
    corner_sofa().export(own / "sofaa" / "one.obj")
    (own / "sofa" / "cut.glb").write_bytes((own / "sofa" / "plain.GLB").read_bytes()[:300])
    (own / "sofa" / "none.obj").write_text("v 0 0 0\n")
    with pytest.warns(InputWarning) as told:
        models = opened(own)
    (said,) = [str(each.message) for each in told if issubclass(each.category, InputWarning)]
    assert said.startswith(f"{own / 'sofaa'} is left out, with 1 models: its name is neither")
    assert set(models.broken) == {"sofa/cut.glb", "sofa/none.obj"}
    assert models.broken["sofa/cut.glb"].startswith("sofa/cut.glb cannot be read (")
    assert models.broken["sofa/none.obj"] == "sofa/none.obj holds no usable triangles"
    assert "\n" not in models.broken["sofa/cut.glb"]


def test_folders_without_a_usable_model_are_sentences(folder, own, tmp_path):
    (tmp_path / "empty").mkdir()
    for name, given, labels in (
        ("missing", tmp_path / "none", "front3d_bedroom"),
        ("empty", tmp_path / "empty", "front3d_bedroom"),
        ("future", folder, "void,spaceship"),
        ("own", own, "void,spaceship"),
    ):
        with refused(f"apps/models_{name}", tmp=tmp_path):
            opened(given, labels)


# -- The package's own furniture -------------------------------------------------------------------


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
        assert trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False).is_watertight, model_id
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
