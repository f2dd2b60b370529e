"""3D-FUTURE: meshes, units, categories, and folders that are something else."""

import numpy as np
import pytest
from front_files import bedroom, room
from front_reading import extent, only_room
from PIL import Image

from data_prep.front.houses import house_files
from data_prep.front.models import ModelBank
from sceneprior.core.errors import InputError
from sceneprior.core.furniture import read_obj


def test_models_a_hundred_times_too_large(front):
    front.model("huge", "Wardrobe", (150.0, 220.0, 60.0))
    found = only_room(front, front.house("house", room("A", [{"jid": "huge", "pos": (0, 0, 0)}])))
    lower, upper = extent(found.furniture[0])
    np.testing.assert_allclose(upper - lower, (1.5, 2.2, 0.6), rtol=1e-6)
    # What the ground truth's matrix is applied to is already in metres.
    np.testing.assert_allclose(found.furniture[0].model_to_room, np.eye(4), atol=1e-12)


@pytest.mark.parametrize(
    "entry",
    [
        {"bbox": [0.09, 0.05, 0.08]},
        {"size": [0.05, 0.09, 0.08]},  # another order of axes
        {"size": ["0.05", "0.08", "0.09"], "bbox": [1]},
    ],
)
def test_small_models_in_centimetres_are_told_by_their_stated_size(front, entry):
    front.model("tiny", "Nightstand", (9.0, 5.0, 8.0))  # below 10 m even as metres
    pieces = [
        {"jid": "tiny", "pos": (1.0, 0, 0), "entry": entry},
        {"jid": "tiny", "pos": (-1.0, 0, 0), "scale": [2, 1, 1], "entry": entry},
    ]
    one, two = only_room(front, front.house("house", room("A", pieces))).furniture
    lower, upper = extent(one)
    np.testing.assert_allclose(upper - lower, (0.09, 0.05, 0.08), rtol=1e-6)
    np.testing.assert_allclose((lower + upper) / 2, (1.0, 0.025, 0), atol=1e-6)
    lower, upper = extent(two)
    np.testing.assert_allclose(upper - lower, (0.18, 0.05, 0.08), rtol=1e-6)
    # One model is one mesh, whatever houses say: the unit belongs to the placement.
    assert one.model is two.model


@pytest.mark.parametrize(
    "entry",
    [
        {},
        {"bbox": [1.9, 1.0, 2.1]},
        {"bbox": [180, 100, 200]},  # the size is in centimetres, the model is not
        {"bbox": [0, 0, 0], "size": ["a", 1, 1]},
        {"bbox": [float("nan")] * 3, "size": None},
        {"bbox": [0.2, 0.1, 0.1]},  # a factor of 10 is some other error: believe the mesh
    ],
)
def test_other_models_are_in_metres(front, entry):
    pieces = [{"jid": "bed", "pos": (0, 0, 0), "entry": entry}]
    (bed,) = only_room(front, front.house("house", room("A", pieces))).furniture
    np.testing.assert_allclose(np.subtract(*extent(bed)[::-1]), (1.8, 1.0, 2.0), rtol=1e-6)


def test_missing_and_broken_models_are_named(front):
    front.list_model("ghost", "Desk")
    front.model("empty", "Desk", (1, 1, 1))
    (front.future / "empty" / "raw_model.obj").write_text("v 0 0 0\n")
    front.model("cut", "Desk", (1, 1, 1))
    (front.future / "cut" / "raw_model.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n")
    pieces = [{"jid": jid, "pos": (0, 0, 0)} for jid in ("bed", "ghost", "empty", "cut", "")]
    found = only_room(front, front.house("house", room("A", pieces)))
    assert [piece.model_id for piece in found.furniture] == ["bed"]
    assert "'ghost' is left out: the models folder has no raw_model.obj for it" in found.notes[0]
    assert "empty/raw_model.obj holds no usable triangles" in found.notes[1]
    assert "cut/raw_model.obj cannot be read" in found.notes[2]
    assert found.notes[3].startswith("'' is left out")
    assert len(found.notes) == 4


def test_unknown_models_and_null_categories_are_void(front):
    front.model("null", None, (1, 1, 1))
    front.model("odd", "Space Ship", (1, 1, 1))
    pieces = [{"jid": "null", "pos": (0, 0, 0)}, {"jid": "odd", "pos": (1, 0, 0)}]
    found = only_room(front, front.house("house", room("A", pieces))).furniture
    assert [(piece.category, piece.label) for piece in found] == [
        ("others", "void"), ("space ship", "void"),
    ]  # fmt: skip


def test_obj_corner_styles(tmp_path):
    path = tmp_path / "model" / "raw_model.obj"
    path.parent.mkdir()
    path.write_text(
        "# c\nv 0 0 0 1.0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\ng a\n"
        "f 1//1 2//1 3//1 4//1\nf -4 -3 -2\n"
    )
    mesh = read_obj(path)
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]]
    assert mesh.vertices_m.dtype == np.float32 and mesh.faces.dtype == np.int32


def test_wrong_folders(front, tmp_path):
    with pytest.raises(InputError, match=r"No folder at .*--front names"):
        house_files(tmp_path / "missing")
    with pytest.raises(InputError, match=r"holds furniture models, not houses"):
        house_files(front.future)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"holds no house JSONs \(<uid>\.json\)\."):
        house_files(tmp_path / "empty")
    front.house("house", bedroom("A"))
    with pytest.raises(InputError, match=r"did you mean .*3D-FRONT"):
        house_files(front.root)
    with pytest.raises(InputError, match=r"No folder at .*--future names"):
        ModelBank(tmp_path / "missing")
    with pytest.raises(InputError, match=r"has no model_info\.json"):
        ModelBank(front.front)
    (front.future / "model_info.json").write_text('{"a": 1}')
    with pytest.raises(InputError, match="is not 3D-FUTURE's list of models"):
        ModelBank(front.future)
    (front.future / "model_info.json").write_bytes(b"\xff")
    with pytest.raises(InputError, match=r"model_info\.json is not JSON"):
        ModelBank(front.future)


def test_the_revised_list_of_models(front):
    (front.future / "model_info.json").rename(front.future / "model_info_revised.json")
    assert ModelBank(front.future).category("bed") == "king-size bed"


@pytest.mark.parametrize("face", ["1 2 99999999999999999999", "1 2 9", "1 2", "a b c", "0 1 2"])
def test_faces_that_are_none(tmp_path, face):
    path = tmp_path / "model" / "raw_model.obj"
    path.parent.mkdir()
    path.write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf {face}\n")
    with pytest.raises(InputError, match=r"^model/raw_model\.obj (cannot be read|holds no usable)"):
        read_obj(path)


def test_a_models_colour(front):
    bank = ModelBank(front.future)
    folder = front.future / "bed"
    assert bank.color("bed") is None and bank.color("nowhere") is None
    (folder / "model.mtl").write_text("newmtl a\nKd 1.0 0.5 0\nnewmtl b\nKd 1 0.5 0\n")
    assert bank.color("bed") == (255, 128, 0)
    (folder / "model.mtl").write_text("Kd nan x\n")
    assert bank.color("bed") is None
    Image.new("RGB", (32, 32), (10, 20, 30)).save(folder / "texture.png")
    assert bank.color("bed") == (10, 20, 30)
    (folder / "texture.png").write_bytes((folder / "texture.png").read_bytes()[:60])
    assert bank.color("bed") is None
