"""3D-FUTURE's models: meshes, read once a process within a budget of memory."""

import os

import numpy as np
import pytest
import trimesh
from refusals import refused

from data_prep.front import furnished
from data_prep.front.furnished import ModelBank
from sceneprior.core.furniture import read_obj


@pytest.fixture
def reads(monkeypatch):
    """The models whose files were read, in order."""
    seen = []

    def noted(path, read=furnished.read_obj):
        seen.append(path.parent.name)
        return read(path)

    monkeypatch.setattr(furnished, "read_obj", noted)
    return seen


def test_a_model_is_read_again_when_it_failed_or_changed(front, reads):
    bank, path = ModelBank(front.future), front.future / "bed" / "raw_model.obj"
    good = path.read_text()
    path.write_text("v 1 2")
    for _ in range(2):
        with refused("front/damaged model"):
            bank.load("bed")
    path.write_text(good)
    assert bank.load("bed") is bank.load("bed") and len(reads) == 3
    status = path.stat()
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns + 1_000_000))
    bank.load("bed")
    assert len(reads) == 4


def test_obj_corner_styles(tmp_path):
    path = tmp_path / "raw_model.obj"
    path.write_text(
        "# c\nv 0 0 0 1.0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\ng a\n"
        "f 1//1 2//1 3//1 4//1\nf -4 -3 -2\n"
    )
    assert read_obj(path).faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]]


@pytest.mark.parametrize("face", ["1 2 99999999999999999999", "1 2 9", "1 2", "a b c", "0 1 2"])
def test_faces_that_are_none(tmp_path, face):
    path = tmp_path / "raw_model.obj"
    path.write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf {face}\n")
    with refused(f"front/model with a face {face}", tmp=tmp_path.name):
        read_obj(path)


def test_wrong_folders_of_models(front, tmp_path):
    front.front.mkdir()
    for name, folder in (("missing", tmp_path / "missing"), ("houses", front.front)):
        with refused(f"front/folder {name} for models", tmp=tmp_path):
            ModelBank(folder)
    for name, content in (("no list", b'{"a": 1}'), ("no text", b"\xff")):
        (front.future / "model_info.json").write_bytes(content)
        with refused(f"front/model_info that is {name}", tmp=tmp_path):
            ModelBank(front.future)


def test_the_revised_list_of_models(front):
    (front.future / "model_info.json").rename(front.future / "model_info_revised.json")
    assert ModelBank(front.future).category("bed") == "king-size bed"


def test_a_plane_of_shadow_is_no_part_of_a_model(front):
    """Nor does it make the model one in centimetres; a model all of whose parts are large is."""
    path = front.future / "bed" / "raw_model.obj"
    plain = ModelBank(front.future).load("bed")
    count = sum(line.startswith("v ") for line in path.read_text().splitlines())
    corners = [(-30, -30), (30, -30), (30, 30), (-30, 30)]
    shadow = "".join(f"v {x} 0 {z}\n" for x, z in corners)
    face = "f " + " ".join(str(count + k) for k in range(1, 5))
    path.write_text(f"{path.read_text().rstrip()}\n{shadow}{face}\n")
    bank = ModelBank(front.future)
    assert bank.load("bed").vertices_m.tolist() == plain.vertices_m.tolist()
    large = "".join(f"v {100 * x} {100 * y} {z}\n" for x in (0, 1) for y in (0, 2) for z in (0, 50))
    path.write_text(large + "f 1 2 4 3\nf 5 6 8 7\nf 1 2 6 5\nf 3 4 8 7\nf 1 3 7 5\nf 2 4 8 6\n")
    assert ModelBank(front.future).load("bed").vertices_m.max(axis=0).tolist() == [1.0, 2.0, 0.5]


def test_a_cabinet_in_centimetres_keeps_its_panels(front):
    """They are flat, large, and have corners of their own; its knob is small."""
    panels, knob = trimesh.creation.box((80, 180, 40)).triangles, trimesh.creation.box((3, 3, 3))
    knob.apply_translation((0, 0, 21.5))
    corners = np.concatenate([panels, knob.triangles]).reshape(-1, 3)
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    lines += [f"f {k} {k + 1} {k + 2}" for k in range(1, len(corners), 3)]
    (front.future / "bed" / "raw_model.obj").write_text("\n".join(lines))
    sides_m = np.ptp(ModelBank(front.future).load("bed").vertices_m, axis=0)
    np.testing.assert_allclose(sides_m, [0.8, 1.8, 0.43], rtol=1e-5)
