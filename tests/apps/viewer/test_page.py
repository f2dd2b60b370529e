"""The page and its panel without a browser: cameras, requests, texts, furniture, downloads."""

import contextlib
import io
import json
import threading
import zipfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from refusals import refused

import sceneprior
from sceneprior.apps.viewer.explorer import Explorer
from sceneprior.apps.viewer.shown import FORMATS, Folder, download
from sceneprior.core.cameras import FILLED, framed, look_at
from sceneprior.core.scene import Opening, Scene, SceneObject
from sceneprior.core.shell import shell_of
from sceneprior.interchange.export import FORMATS as EXPORT_FORMATS
from sceneprior.interchange.export import export_scenes
from sceneprior.render.scene_files import save

pytest.importorskip("viser", reason="the extra `view` is not installed")

from sceneprior.apps.viewer import page as pages
from sceneprior.apps.viewer import views
from sceneprior.apps.viewer.panel import Panel, open_page
from sceneprior.apps.viewer.server import serving
from sceneprior.apps.viewer.texts import html, wishes_html

CLASS = "<img src=x onerror='hacked=1'>"
NAME = "![](_icons/tabler-icons.zip) <iframe srcdoc='<script>parent.hacked=1</script>'>"
FLOOR = np.array([[-2.0, -1.5], [2, -1.5], [2, 1.5], [-2, 1.5]])
BED = SceneObject("double_bed", (0.0, 0.5, 0.0), (2.0, 1.0, 2.2))
DOOR = Opening("door", (-0.5, -1.5), (0.4, -1.5), 0.0, 2.0)
ROOM = Scene("mine", "front3d_bedroom", (BED,), FLOOR, openings=(DOOR,))


@pytest.mark.parametrize("forward", [views.CORNER, views.DOWN])
@pytest.mark.parametrize("aspect", [0.4, 1.3, 3.0])
def test_cameras_see_all_points_and_stand_no_further_away_than_they_must(forward, aspect, rng):
    points = rng.uniform([-4, 0, -2], [3, 2.6, 5], (40, 3))
    eye, target = framed(points, forward, 0.75, aspect)
    matrix = look_at(eye, target)
    x, y, z = matrix[:3, :3] @ points.T + matrix[:3, 3:]
    assert (z > 0).all()
    slope = np.tan(0.75 / 2)
    filled = max((abs(x) / z).max() / (slope * aspect), (abs(y) / z).max() / slope)
    assert filled == pytest.approx(FILLED, abs=1e-9)
    np.testing.assert_allclose(np.cross(target - eye, forward), 0, atol=1e-9)


def test_names_are_escaped_and_read_no_file(recwarn):
    """A class, a name and a wish out of a stranger's file are shown as they are."""
    item = SceneObject(CLASS, (0.0, 0.5, 0.0), (1.0, 1.0, 1.0))
    wishes = [{"wish": CLASS, "holds": True}, {"wish": CLASS, "holds": "<b>"}, CLASS, None]
    room = Scene(NAME, f"void,{CLASS}", (item,), extra={"wishes": wishes})
    with serving("127.0.0.1", 0) as server:
        panel = open_page(server, Folder([room]), CLASS)
        texts = [panel._room_text.content]
        panel.page.show(panel.page.shown.toggled(0))
        texts.append(panel._room_text.content)
    assert not [warning for warning in recwarn if "image" in str(warning.message)]
    for text in (*texts, html(CLASS)):
        assert "&lt;img src=x onerror=&#39;hacked=1&#39;&gt;" in text
        assert "<img" not in text and "<iframe" not in text
    assert "![]" in texts[0] and texts[0].count("not fulfilled") == 1
    for other in (None, {}, CLASS, [], 3):
        assert not wishes_html(Scene(NAME, "front3d_bedroom", extra={"wishes": other}))


@pytest.fixture(scope="module")
def prior():
    return sceneprior.load("procthor-bedroom")


def chip(panel, text: str) -> str:
    """The chip of a part, as it is written now."""
    return next(option for option in panel._chips.options if text in option)


def press(panel, control, value=None) -> None:
    """Send what a browser sends when a control is used."""
    if value is not None:
        control._impl.value = value
    for answer in control._impl.update_cb:
        answer(SimpleNamespace(client=None))


def test_the_page_owns_one_request(prior):
    asked = {"want": "a 4 x 3 m bedroom with a door and two nightstands"}
    with serving("127.0.0.1", 0) as server:
        panel = open_page(server, Explorer(prior), "prior", asked=asked)
        page, said = panel.page, []
        page.tell = lambda text: said.append(text) if text else None
        assert panel.line.value == asked["want"]
        assert panel._chips.options == (
            "✓ a 4 x 3 m bedroom  ×",
            "✓ a door  ×",
            "✓ two nightstands  ×",
        )
        first, same = page.shown.scene, prior.sample(1, 0, **asked)[0]
        assert first.without_meshes().objects == same.without_meshes().objects
        assert "Floor: 4.00 x 3.00 m, 1 door" in panel._room_text.content
        # A part less: the room stays, and the next one has another number of nightstands or not.
        press(panel, panel._chips, chip(panel, "two nightstands"))
        assert panel.line.value == "a 4 x 3 m bedroom, a door" and page.shown.scene is first
        assert panel._chips.options == ("✓ a 4 x 3 m bedroom  ×", "✓ a door  ×")
        panel.line.value = "4 x 3 m, a door in the north wall, no nightstand\n"
        assert panel.line.value == "4 x 3 m, a door in the north wall, no nightstand"
        assert {option[0] for option in panel._chips.options} == {"✓"} and not said
        assert chip(panel, "door") == "✓ a door in the north wall  ×"
        # Words that are not understood leave all as it is, and are said once.
        shown = page.shown
        panel.line.value = "a purple bed\n"
        assert page.shown is shown and len(said) == 1 and "not understood: 'purple'" in said[0]
        page.undo()
        assert (
            "nightstand" not in panel.line.value
            and page.shown.request.want == "a 4 x 3 m bedroom, a door"
        )
        page.undo()
        assert panel.line.value == asked["want"] and page.shown.scene is first
        with refused("viewer/nothing_to_undo"):
            page.undo()
        with refused("viewer/nothing_picked"):
            panel.lock()
        with refused("viewer/nothing_locked"):
            panel.complete()


def test_pieces_are_picked_locked_completed_and_replaced(prior):
    with serving("127.0.0.1", 0) as server:
        panel = open_page(server, Explorer(prior), "prior", asked={"want": "4 x 3 m, a bed"})
        page = panel.page
        page.pick(0)
        assert page.shown.picked == 0 and panel._pieces.options[0] == "Lock this piece"
        press(panel, panel._pieces, "Lock this piece")
        assert page.shown.locked == {0} and panel._pieces.options[0] == "Unlock this piece"
        bed = page.shown.scene.objects[0]
        press(panel, panel._pieces, "Complete")
        assert page.shown.scene.objects[0].center_m == bed.center_m and page.shown.picked is None
        page.pick(1)
        before = page.shown.scene
        press(panel, panel._pieces, "Replace by model")
        changed = [
            a is not b for a, b in zip(page.shown.scene.objects, before.objects, strict=True)
        ]
        assert changed == [row == 1 for row in range(len(changed))]
        press(panel, panel._pieces, "Undo")
        assert page.shown.scene is before
        panel.follows.value = False
        panel.drop(1, 0.2, 0.0)
        assert page.shown.locked == {0, 1} and page.shown.scene.objects[2:] == before.objects[2:]
        press(panel, panel._pieces, "Undo")
        panel.follows.value = True
        panel.drop(1, 0.2, 0.0)
        labels = [[item.label for item in scene.objects] for scene in (page.shown.scene, before)]
        assert sorted(labels[0]) == sorted(labels[1]) and "2 locked pieces" in page.shown.origin
        press(panel, panel._pieces, "Undo")
        assert page.shown.scene is before  # one step, although the rest has followed


@pytest.mark.parametrize("source", ["prior", "folder"])
def test_values_that_the_page_does_not_offer_are_refused(prior, source, capfd, monkeypatch):
    """A client may send any value for any control."""
    room = Explorer(prior) if source == "prior" else Folder([ROOM, ROOM])
    said = []
    monkeypatch.setattr(Panel, "_said", lambda self: said.append)
    with serving("127.0.0.1", 0) as server:
        page = open_page(server, room, "mine").page
        page.follow = lambda task, tell=None: page.safely(task, tell)
        event, tried = SimpleNamespace(client=SimpleNamespace(client_id=0)), 0
        for control in [*server.gui._gui_input_handle_from_uuid.values()]:
            most = getattr(control, "max", None)
            values = () if most is None else (control.min - 1, most + 1)
            for value in ("glb", "") if hasattr(control, "options") else values:
                control._impl.value = value
                for answer in control._impl.update_cb:
                    answer(event)
                tried += 1
            if getattr(control, "label", None) == "Download":
                for answer in control._impl.update_cb:
                    answer(event)
                answered = said[-1]
    assert answered.startswith("'' is not offered here; choose from GLB, JSON")
    assert tried > 5 and capfd.readouterr() == ("", "")


def test_rooms_are_drawn_in_one_thread():
    """Each thread that draws rooms keeps megabytes, and the server answers from 32."""
    threads = set()
    with serving("127.0.0.1", 0) as server, ThreadPoolExecutor(8) as pool:
        page = open_page(server, Folder([ROOM]), "mine").page

        def task() -> None:
            page.safely(lambda: threads.add(threading.get_ident()))  # one in the other

        for _ in range(40):
            pool.submit(page.safely, task)
            page.follow(task)
    assert len(threads) == 1


class FakeScene:
    """Takes what is added, and keeps the names in order, and the newest handle of each."""

    def __init__(self):
        self.added, self.nodes = [], {}

    def __getattr__(self, kind: str):
        if not kind.startswith("add_"):
            return MagicMock()

        def add(name: str, *values, **settings):
            self.added.append(name)
            self.nodes[name] = MagicMock(values=values, **settings)
            self.nodes[name].remove.side_effect = lambda: self.nodes.pop(name)
            return self.nodes[name]

        return add


@pytest.fixture
def fake():
    return FakeScene()


def page_of(fake: FakeScene, scene: Scene, shell: str = "walls") -> pages.Page:
    server = SimpleNamespace(
        scene=fake, atomic=nullcontext, initial_camera=SimpleNamespace(), get_clients=dict,
        on_client_connect=lambda _: None,
    )  # fmt: skip
    return pages.Page(server, Folder([scene]), shell=shell)


def drawn(fake: FakeScene, scene: Scene, shell: str, chosen=None, **state):
    """The names of the nodes of a page's room."""
    page = page_of(fake, scene, shell)
    vars(page).update(chosen or {})
    page.show(replace(page.shown, **state))
    return {name.removeprefix("/room/") for name in fake.nodes} - {"/sky", "/sun"}


def test_names_and_boxes_are_of_what_is_chosen_picked_or_locked(fake):
    lamp = SceneObject("pendant_lamp", (1.0, 2.0, 0.0), (0.4, 0.6, 0.4))
    room = Scene("room", "front3d_bedroom", (BED, lamp))
    objects = {"/grid", "object_0", "object_1"}
    assert drawn(fake, room, "none") == objects and fake.nodes["/grid"].visible
    assert drawn(fake, room, "none", picked=1) == objects | {"name_1", "box_1"}
    assert fake.nodes["/room/name_1"].values == ("pendant lamp 0.40 x 0.60 x 0.40 m",)
    assert len(fake.nodes["/room/box_1"].values[0]) == 12
    fake = FakeScene()
    assert drawn(fake, room, "none", locked=frozenset({0})) == objects | {"name_0", "box_0"}
    assert fake.nodes["/room/name_0"].values[0].startswith("🔒 double bed")
    every = objects | {"name_0", "name_1", "box_0", "box_1"}
    assert drawn(fake, room, "none", {"names": True, "boxes": True}) == every
    assert drawn(FakeScene(), replace(room, objects=()), "none", {"names": True}) == {"/grid"}


def test_of_walls_towards_the_camera_outlines_and_openings_stay(fake):
    names = drawn(fake, ROOM, "walls")
    walls = [fake.nodes[f"/room/wall_{row}"] for row in range(4)]
    assert all(node.side == "front" for node in walls) and not fake.nodes["/grid"].visible
    shell = shell_of(ROOM)
    for node, wall in zip(walls, shell.walls, strict=True):
        # All faces lie in the plane of the inner face: no reveal of the door stays by itself.
        vertices, faces = node.values
        beyond = (vertices[faces][..., [0, 2]] - wall.start_m) @ wall.outward
        assert len(faces) and np.abs(beyond).max() < 1e-6
    edges = fake.nodes["/room/edges"].values[0]
    assert {tuple(point) for point in edges.reshape(-1, 3)[:, [0, 2]]} == {*map(tuple, FLOOR)}
    (door,) = {name for name in names if name.endswith("_back")}
    kind, front = door.startswith("door_"), fake.nodes[f"/room/{door.removesuffix('_back')}"]
    ends_m = sorted(front.values[0][:, [0, 2]].tolist())
    np.testing.assert_allclose(ends_m, [DOOR.start_m] * 2 + [DOOR.end_m] * 2, atol=1e-9)
    assert kind
    for node, sign in ((front, 1), (fake.nodes[f"/room/{door}"], -1)):  # it faces the room, or not
        a, b, c = node.values[0][node.values[1][0]]
        assert node.side == "front" and sign * np.cross(b - a, c - a)[2] > 0
    assert (fake.nodes["/room/ceiling"].values[0][:, 1] >= 2.6).all()
    assert drawn(FakeScene(), ROOM, "floor") == {"/grid", "floor", "object_0"}


def client_of(width: int, height: int) -> SimpleNamespace:
    camera = SimpleNamespace(image_width=width, image_height=height, aspect=width / height)
    return SimpleNamespace(client_id=0, camera=camera, atomic=nullcontext)


@pytest.mark.parametrize("view", views.VIEWS)
@pytest.mark.parametrize("size", [(930, 796), (390, 844)])
def test_views_show_the_room_above_the_drawer_of_a_phone(fake, view, size):
    page, client = page_of(fake, ROOM), client_of(*size)
    page.look(view, client)
    camera = client.camera
    matrix = look_at(camera.position, camera.look_at)
    x, y, z = matrix[:3, :3] @ views.room_points(ROOM, True).T + matrix[:3, 3:]
    slope = np.tan(camera.fov / 2)
    if view == "Walk in":  # at the door, with the eyes inside the room
        np.testing.assert_allclose(camera.position, [-0.05, views.EYE_M, -1.5 + views.STEP_M])
        return
    low = 1 if size[0] > 600 else 1 - 2 * views.DRAWER
    assert (z > 0).all() and (abs(x) < slope * camera.aspect * z).all()
    assert (y > -slope * z).all() and (y < low * slope * z).all()


class LateCamera(SimpleNamespace):
    """A camera of viser's: what equals its state is not sent, and the browser's reports, here of
    the first view forever, replace the state."""

    def __setattr__(self, name: str, value):
        first = self.first.setdefault(name, value)
        if not np.allclose(first, value) or name not in self.sent:
            self.sent[name] = value


def test_a_view_reaches_a_browser_whose_reports_are_late(fake):
    page, client = page_of(fake, ROOM), client_of(930, 796)
    client.camera = LateCamera(first={}, sent={}, **vars(client.camera))
    page.look("From outside", client)
    expected = dict(client.camera.sent)
    page.look("Walk in", client)
    assert np.abs(client.camera.sent["position"] - expected["position"]).max() > 1
    page.look("From outside", client)
    for name in ("fov", "position", "look_at"):
        np.testing.assert_allclose(client.camera.sent[name], expected[name], atol=1e-9)


def test_a_dragged_piece_follows_the_pointer_on_the_floor(fake):
    page, dropped = page_of(fake, ROOM), []
    page.follow = lambda task: task()
    page.on_drop = lambda *where: dropped.append(where)
    eye, grabbed = np.array([0.0, 4.0, 5.0]), np.array([0.2, 1.0, 0.5])
    drag = page._dragger(0)
    for phase, to in (("start", grabbed), ("update", [0.7, 1.0, 0.0]), ("end", [0.7, 1.0, 0.0])):
        way = np.asarray(to) - eye
        client = SimpleNamespace(camera=SimpleNamespace(position=eye))
        event = SimpleNamespace(
            phase=phase, client=client, start_position=grabbed, end_position=eye + 0.4 * way
        )
        with contextlib.suppress(StopIteration):
            drag(event).send(None)
    np.testing.assert_allclose(fake.nodes["/room/object_0"].position, (0.5, 0, -0.5), atol=1e-9)
    np.testing.assert_allclose(dropped, [(0, 0.5, -0.5)], atol=1e-9)


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
