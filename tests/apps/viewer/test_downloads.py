"""Downloads are what `export` and `save` write."""

import io
import json
import zipfile

import pytest

from sceneprior.apps.viewer.downloads import EXPORTED, FORMATS, download
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Opening, Scene, SceneObject
from sceneprior.interchange.export import FORMATS as EXPORT_FORMATS
from sceneprior.interchange.export import export_scenes
from sceneprior.render.scene_files import save

BED = SceneObject("double_bed", (0.0, 0.3, 0.0), (1.8, 0.6, 2.0))
DOOR = Opening("door", (-0.5, -1.5), (0.4, -1.5), 0.0, 2.0)


@pytest.fixture
def room(square_floor):
    return Scene("mine", "front3d_bedroom", (BED,), square_floor, openings=(DOOR,))


@pytest.fixture
def square_floor():
    import numpy as np

    return np.array([[-2, -1.5], [2, -1.5], [2, 1.5], [-2, 1.5]])


def test_every_format_of_export_is_offered():
    assert set(EXPORTED.values()) == set(EXPORT_FORMATS)


@pytest.mark.parametrize("form", FORMATS)
def test_a_download_is_what_export_writes(form, room, tmp_path):
    if form == "USD":
        pytest.importorskip("pxr", reason="the extra `usd` is not installed")
    name, content, _ = download(room, form, "walls")
    assert download(room, form, "walls")[1] == content
    if form not in EXPORTED:
        save(room, tmp_path / "mine.json")
        assert name in ("mine.glb", "mine.json")
        if name == "mine.json":
            assert content == (tmp_path / "mine.json").read_bytes()
        else:
            assert b"wall_0" in content and b"wall_0" not in download(room, form, "floor")[1]
        return
    to = EXPORTED[form]
    shell = None if to in ("sceneeval", "atiss", "threed-front") else "walls"
    export_scenes([room], to, tmp_path, shell)
    written = {p.relative_to(tmp_path).as_posix(): p for p in tmp_path.rglob("*") if p.is_file()}
    if not name.endswith(".zip"):
        assert name == next(iter(written)) and len(written) == 1
        assert content == written[name].read_bytes()
        return
    assert name == f"mine_{to}.zip"
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert set(archive.namelist()) == set(written)
        for path in written:
            if path.endswith(".json"):
                assert json.loads(archive.read(path)) == json.loads(written[path].read_text())


def test_a_name_that_is_no_file_s_is_a_sentence(room):
    from dataclasses import replace

    for name in ("../mine", "a/b", ""):
        with pytest.raises(InputError, match="cannot be the name of a file"):
            download(replace(room, name=name), "GLB", "walls")
