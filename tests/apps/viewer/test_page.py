"""The page and its panel without a browser: cameras, requests, texts, furniture, downloads."""

import io
import json
import zipfile
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from refusals import refused

import sceneprior
from sceneprior.apps.viewer.explorer import Explorer, Folder
from sceneprior.core.cameras import look_at
from sceneprior.core.scene import Opening, Scene, SceneObject
from sceneprior.interchange.export import FORMATS as EXPORT_FORMATS
from sceneprior.interchange.export import export_scenes
from sceneprior.render.scene_files import save

pytest.importorskip("viser", reason="the extra `view` is not installed")

from sceneprior.apps.viewer import page as pages
from sceneprior.apps.viewer.panel import FORMATS, download, open_page
from sceneprior.apps.viewer.panel_html import error_html, html, wishes_html
from sceneprior.apps.viewer.server import serving

CLASS = "<img src=x onerror='hacked=1'>"
NAME = "![](_icons/tabler-icons.zip) <iframe srcdoc='<script>parent.hacked=1</script>'>"
FLOOR = np.array([[-2.0, -1.5], [2, -1.5], [2, 1.5], [-2, 1.5]])
BED = SceneObject("double_bed", (0.0, 0.5, 0.0), (2.0, 1.0, 2.2))
DOOR = Opening("door", (-0.5, -1.5), (0.4, -1.5), 0.0, 2.0)
ROOM = Scene("mine", "front3d_bedroom", (BED,), FLOOR, openings=(DOOR,))


@pytest.mark.parametrize("forward", [pages.CORNER, pages.FRONT])
@pytest.mark.parametrize("aspect", [0.4, 1.3, 3.0])
def test_cameras_see_all_points_and_stand_no_further_away_than_they_must(forward, aspect, rng):
    points = rng.uniform([-4, 0, -2], [3, 2.6, 5], (40, 3))
    eye, target = pages.framed(points, forward, 0.75, aspect)
    matrix = look_at(eye, target)
    x, y, z = matrix[:3, :3] @ points.T + matrix[:3, 3:]
    assert (z > 0).all()
    slope = np.tan(0.75 / 2)
    filled = max((abs(x) / z).max() / (slope * aspect), (abs(y) / z).max() / slope)
    assert filled == pytest.approx(pages.MARGIN, abs=1e-9)
    np.testing.assert_allclose(np.cross(target - eye, forward), 0, atol=1e-9)


def test_bounds_hold_floor_furniture_and_walls():
    shelf = SceneObject("shelf", (1.0, 1.6, 0.0), (0.5, 3.0, 0.4))
    scene = Scene("room", "front3d_bedroom", (shelf,), FLOOR, ceiling_m=3.5)
    assert pages.room_bounds(scene, False).tolist() == [[-2, 0, -1.5], [2, 3.1, 1.5]]
    assert pages.room_bounds(scene, True).tolist() == [[-2, 0, -1.5], [2, 3.5, 1.5]]
    corners = pages.box_points(np.array([[0.0, 1, 2], [3, 4, 5]]))
    assert sorted(map(tuple, corners.tolist())) == [
        (x, y, z) for x in (0, 3) for y in (1, 4) for z in (2, 5)
    ]


def test_names_are_escaped_and_read_no_file(recwarn):
    """A class, a name and a wish out of a stranger's file are shown as they are."""
    item = SceneObject(CLASS, (0.0, 0.5, 0.0), (1.0, 1.0, 1.0))
    wishes = [{"wish": CLASS, "holds": True}, {"wish": CLASS, "holds": "<b>"}, CLASS, None]
    room = Scene(NAME, f"void,{CLASS}", (item,), extra={"wishes": wishes})
    with serving("127.0.0.1", 0) as server:
        panel = open_page(server, Folder([room]), CLASS)
        texts = [panel._room_text.content, panel._wishes_text.content]
        panel.page.show(panel.page.shown.toggled(0))
        texts.append(panel._room_text.content)
    assert not [warning for warning in recwarn if "image" in str(warning.message)]
    for text in (*texts, html(error_html(CLASS)), html(CLASS)):
        assert "&lt;img src=x onerror=&#39;hacked=1&#39;&gt;" in text
        assert "<img" not in text and "<iframe" not in text
    assert "![]" in texts[0] and texts[1].count("not fulfilled") == 1
    for other in (None, {}, CLASS, [], 3):
        assert not wishes_html(Scene(NAME, "front3d_bedroom", extra={"wishes": other}))


@pytest.fixture(scope="module")
def prior():
    return sceneprior.load("procthor-bedroom")


def test_a_request_is_answered_or_refused_in_the_panel(prior, tmp_path):
    asked = {"floor": np.array([[0, 0], [4, 0], [4, 3], [0, 3]]), "want": {"nightstand": 2}}
    with serving("127.0.0.1", 0) as server:
        panel = open_page(server, Explorer(prior), "prior", asked=asked)
        page, request, fields = panel.page, panel.request, panel.request.fields
        assert "The command also requests: floor, want." in request.rest_text.content
        assert "✓ 2 nightstand" in panel._wishes_text.content
        fields["want"].value, fields["openings"].value = "double_bed: 1", "door@south,"
        panel.sample(page.source, 1, None)
        assert page.shown.origin == "seed 1, from: sampler, as requested"
        assert "✓ 1 double bed" in panel._wishes_text.content
        same = prior.sample(
            1, 1, floor=asked["floor"], openings="door@south", want={"double_bed": 1}
        )[0]
        assert page.scene.without_meshes().objects == same.without_meshes().objects
        assert page.scene.openings == same.openings
        assert "Floor: 4.00 x 3.00 m, 1 door" in panel._room_text.content
        shown = page.shown
        fields["want"].value = "a purple bed"
        page.safely(lambda: panel.sample(page.source, 1, None))
        assert "not understood: &#39;purple&#39;" in panel._wishes_text.content
        assert page.shown is shown
        request.clear()
        assert request.asked() == {} and request.rest_text.visible is False
        fields["ceiling_m"].value = "high"
        with refused("viewer/ceiling_of_words"):
            request.asked()
        fields["ceiling_m"].value = "2.4 m"
        assert request.asked() == {"ceiling_m": 2.4}
        with refused("viewer/request_of_latents"):
            page.source.sample(0, "paper", request.asked())
        # A floor's file may be named on the command line, never in the browser.
        (tmp_path / "floor.json").write_text("[[0, 0], [4, 0], [4, 3], [0, 3]]")
        for text in (f"{tmp_path}/floor.json", f"{tmp_path}/floor.json:room", "floor.npz"):
            fields["floor"].value = text
            with refused("viewer/floor_of_a_file", text=text[:60]):
                request.asked()


def test_a_camera_that_the_user_has_moved_stays_when_the_window_changes_its_shape():
    camera = SimpleNamespace(aspect=1.3, fov=0.75, wxyz=(1.0, 0, 0, 0), on_update=lambda f: None)
    client = SimpleNamespace(client_id=7, camera=camera, atomic=nullcontext)
    camera.on_update = lambda update: setattr(camera, "update", update)
    with serving("127.0.0.1", 0) as server:
        page = open_page(server, Folder([ROOM]), "rooms").page
        page._connected(client)
        for turned in (False, True):
            before = camera.position = camera.position + turned
            camera.aspect /= 2
            camera.update(camera)
            assert np.array_equal(camera.position, before) == turned


def test_models_and_a_nearest_room_come_and_go(toy_run):
    with serving("127.0.0.1", 0) as server:
        panel = open_page(server, Explorer(sceneprior.load(toy_run)), "rooms")
        page = panel.page
        before = page.scene.objects
        page.display.models = page.display.nearest = True
        page.show(page.shown)
        assert page.scene.extra["retrieval"] and page.scene.objects[0].mesh is not None
        assert "m away in layout" in panel._nearest_text.content and page._beside.frame.visible
        page.display.models = page.display.nearest = False
        page.show(page.shown)
        assert page.scene.objects == before
        assert panel._nearest_text.content == "" and not page._beside.frame.visible


def test_every_format_of_export_is_offered():
    assert {to for to in FORMATS.values() if not to.startswith(".")} == set(EXPORT_FORMATS)


@pytest.mark.parametrize("form", FORMATS)
def test_a_download_is_what_export_writes(form, tmp_path):
    if form == "USD":
        pytest.importorskip("pxr", reason="the extra `usd` is not installed")
    name, content, _ = download(ROOM, form, "walls")
    assert download(ROOM, form, "walls")[1] == content
    to = FORMATS[form]
    if to.startswith("."):
        save(ROOM, tmp_path / f"mine{to}", shell="walls")
    else:
        shell = None if to in ("sceneeval", "atiss", "threed-front") else "walls"
        export_scenes([ROOM], to, tmp_path, shell)
    written = {p.relative_to(tmp_path).as_posix(): p for p in tmp_path.rglob("*") if p.is_file()}
    if not name.endswith(".zip"):
        assert {name: content} == {key: path.read_bytes() for key, path in written.items()}
        return
    assert name == f"mine_{to}.zip"
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert set(archive.namelist()) == set(written)
        for path in written:
            if path.endswith(".json"):
                assert json.loads(archive.read(path)) == json.loads(written[path].read_text())


@pytest.mark.parametrize("name", ["../mine", "a/b", ""])
def test_a_name_that_is_no_file_s_is_a_sentence(name):
    with refused("viewer/download_name", name=repr(name)):
        download(replace(ROOM, name=name), "GLB", "walls")
