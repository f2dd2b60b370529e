"""CAD models by class: which there are, which are broken, and that points are drawn once."""

import numpy as np
import pytest
import trimesh
from model_folder import blocks, corner_sofa, write_model, write_models

from sceneprior.apps.retrieval import model_folders
from sceneprior.apps.retrieval.cad_models import open_models
from sceneprior.core.errors import InputError


@pytest.fixture
def folder(tmp_path):
    """Two beds, one a hundred times too large, a flat table, a toy, and four broken ones."""
    bed = blocks(((0, 0.3, 0), (1.8, 0.6, 2.0)), ((0, 0.6, -0.95), (1.8, 1.2, 0.1)))
    huge = bed.copy()
    huge.apply_scale(100)
    flat = trimesh.Trimesh([[0, 0, 0], [2, 0, 0], [2, 0, 1], [0, 0, 1]], [[0, 1, 2], [0, 2, 3]])
    made = write_models(
        tmp_path / "models",
        {
            "bed": ("King-size Bed", bed),
            "huge": ("King-size Bed", huge),
            "flat": ("Dining Table", flat),
            "toy": ("Toy", bed),
            "nan": ("Nightstand", bed),
            "faceless": ("Nightstand", bed),
            "missing": ("Nightstand", bed),
            "point": ("Nightstand", bed),
        },
    )
    (made / "nan" / "raw_model.obj").write_text("v 0 0 0\nv nan 1 0\nv 1 0 0\nf 1 2 3\n")
    (made / "faceless" / "raw_model.obj").write_text("v 0 0 0\n")
    (made / "point" / "raw_model.obj").write_text("v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n")
    (made / "missing" / "raw_model.obj").unlink()
    return made


@pytest.fixture
def drawn(monkeypatch):
    """Names of the folders whose OBJ was read."""
    reads = []
    read = model_folders.read_obj
    monkeypatch.setattr(
        model_folders, "read_obj", lambda path: reads.append(path.parent.name) or read(path)
    )
    return reads


def open_here(folder, points=64):
    return open_models(folder, "front3d_bedroom", folder.parent / "cache", points)


def test_models_by_class_and_broken_models(folder):
    models = open_here(folder)
    assert {label: some.model_ids for label, some in models.by_class.items()} == {
        "double_bed": ("bed", "huge"),
        "table": ("flat",),
    }
    assert set(models.broken) == {"nan", "faceless", "missing", "point"}
    assert "no usable triangles" in models.broken["nan"] and "no area" in models.broken["point"]
    assert "cannot be read" in models.broken["missing"]
    beds = models.by_class["double_bed"].points
    assert beds.shape == (2, 64, 3) and np.abs(beds).max() <= 0.5
    # A hundred times too large is the same model in its unit box.
    np.testing.assert_allclose(beds[0], beds[1], atol=1e-6)
    assert (models.by_class["table"].points[..., 1] == 0).all()  # flat stays flat
    np.testing.assert_allclose(np.ptp(models.load("huge").vertices_m, axis=0), 1)


def test_points_are_drawn_once_and_again_where_a_file_changed(folder, drawn):
    first = open_here(folder)
    assert sorted(drawn) == ["bed", "faceless", "flat", "huge", "nan", "point"]
    drawn.clear()
    again = open_here(folder)
    assert sorted(drawn) == ["faceless", "nan", "point"]  # broken ones may have been mended
    np.testing.assert_array_equal(
        first.by_class["double_bed"].points, again.by_class["double_bed"].points
    )
    drawn.clear()
    write_model(folder, "bed", corner_sofa())
    changed = open_here(folder)
    assert "bed" in drawn and "huge" not in drawn
    beds = changed.by_class["double_bed"].points
    assert np.abs(beds[0] - first.by_class["double_bed"].points[0]).max() > 0.05
    np.testing.assert_array_equal(beds[1], first.by_class["double_bed"].points[1])
    drawn.clear()
    assert open_here(folder, points=32).by_class["table"].points.shape == (1, 32, 3)
    assert "huge" in drawn  # other settings, another file
    assert len(list((folder.parent / "cache").iterdir())) == 2


def test_a_damaged_file_of_points_is_written_again(folder, drawn):
    open_here(folder)
    (path,) = (folder.parent / "cache").iterdir()
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    drawn.clear()
    open_here(folder)
    assert "huge" in drawn and path.read_bytes() == whole


def test_what_was_drawn_before_an_interrupt_is_kept(folder, drawn):
    def stop_after_two(ids):
        yield from ids[:2]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        open_models(folder, "front3d_bedroom", folder.parent / "cache", 64, stop_after_two)
    done = set(drawn)
    drawn.clear()
    open_here(folder)
    assert not (set(drawn) - {"nan", "faceless", "point"}) & done


def test_folders_without_a_usable_model_are_sentences(folder, tmp_path):
    with pytest.raises(InputError, match=r"No folder at .*none; --models names"):
        open_models(tmp_path / "none", "front3d_bedroom", tmp_path)
    with pytest.raises(InputError) as error:
        open_models(folder, "void,spaceship", tmp_path)
    assert "holds no usable model of a class of void,spaceship (8 models listed, 0" in str(
        error.value
    )


def test_ids_that_leave_the_folder_are_broken_models(tmp_path):
    write_models(tmp_path / "models", {"table": ("Dining Table", corner_sofa())})
    info = tmp_path / "models" / "model_info.json"
    info.write_text(info.read_text()[:-1] + ', {"model_id": "../x", "category": "Dining Table"}]')
    models = open_models(tmp_path / "models", "front3d_bedroom", tmp_path / "cache", 16)
    assert "cannot be a folder's name" in models.broken["../x"]
