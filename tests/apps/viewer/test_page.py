"""The page and its panel without a browser: cameras, requests, texts, furniture, downloads."""

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
import torch
from refusals import refused

import sceneprior
from sceneprior.apps.viewer.explorer import FORMATS, Display, Explorer, Folder, download, make_map
from sceneprior.core.cameras import FILLED, framed, look_at
from sceneprior.core.scene import Opening, Scene, SceneObject
from sceneprior.core.shell import shell_of
from sceneprior.interchange.export import FORMATS as EXPORT_FORMATS
from sceneprior.interchange.export import export_scenes
from sceneprior.paper.prior import LatentCube
from sceneprior.render.scene_files import save

pytest.importorskip("viser", reason="the extra `view` is not installed")

from sceneprior.apps.viewer import page as pages
from sceneprior.apps.viewer.panel import html, open_page, wishes_html
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
        texts = [panel._room_text.content, panel._wishes_text.content]
        panel.page.show(panel.page.shown.toggled(0))
        texts.append(panel._room_text.content)
    assert not [warning for warning in recwarn if "image" in str(warning.message)]
    for text in (*texts, html(CLASS)):
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


@pytest.mark.parametrize("source", ["prior", "folder"])
def test_values_that_the_page_does_not_offer_are_refused(prior, source, capfd):
    """A client may send any value for any control."""
    room = Explorer(prior) if source == "prior" else Folder([ROOM, ROOM])
    with serving("127.0.0.1", 0) as server:
        page = open_page(server, room, "mine").page
        page.follow = page.safely
        said = []
        client = SimpleNamespace(add_notification=lambda *words, **_: said.append(words))
        server.get_clients = lambda: {0: client}
        tried = 0
        for control in [*server.gui._gui_input_handle_from_uuid.values()]:
            most = getattr(control, "max", None)
            values = () if most is None else (control.min - 1, most + 1)
            for value in ("glb", "") if hasattr(control, "options") else values:
                control._impl.value = value
                said.clear()
                for answer in control._impl.update_cb:
                    answer(SimpleNamespace(client=client))
                tried += 1
            if getattr(control, "label", None) == "Download":
                for answer in control._impl.update_cb:
                    answer(SimpleNamespace(client=client))
                answered = said[-1][1]
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
        def add(name: str, *values, **settings):
            self.added.append(name)
            self.nodes[name] = MagicMock(values=values, **settings)
            self.nodes[name].remove.side_effect = lambda: self.nodes.pop(name)
            return self.nodes[name]

        return add


@pytest.fixture
def fake():
    return FakeScene()


def drawn(fake: FakeScene, scene: Scene, shell: str, kept: tuple[int, ...] = (), **chosen: bool):
    """The names of the nodes of a page's room."""
    server = SimpleNamespace(
        scene=fake, atomic=nullcontext, initial_camera=SimpleNamespace(), get_clients=dict,
        on_client_connect=lambda _: None,
    )  # fmt: skip
    page = pages.Page(server, Folder([scene]), shell=shell)
    page.display = Display(shell, **chosen)
    page.show(replace(page.shown, kept=frozenset(kept)))
    return {name.removeprefix("/room/") for name in fake.nodes} - {"+y"}


def test_names_and_boxes_are_of_what_is_chosen_or_kept(fake):
    lamp = SceneObject("pendant_lamp", (1.0, 2.0, 0.0), (0.4, 0.6, 0.4))
    room = Scene("room", "front3d_bedroom", (BED, lamp))
    objects = {"/grid", "object_0", "object_1"}
    assert drawn(fake, room, "none") == objects and fake.nodes["/grid"].visible
    assert drawn(fake, room, "none", kept=(1,)) == objects | {"name_1", "box_1"}
    assert fake.nodes["/room/name_1"].values == ("pendant lamp 0.40 x 0.60 x 0.40 m",)
    assert len(fake.nodes["/room/box_1"].values[0]) == 12
    every = objects | {"name_0", "name_1", "box_0", "box_1"}
    assert drawn(fake, room, "none", names=True, boxes=True) == every
    assert drawn(FakeScene(), replace(room, objects=()), "none", names=True) == {"/grid"}


def test_of_walls_only_what_faces_the_room_is_drawn(fake):
    drawn(fake, ROOM, "walls")
    walls = [fake.nodes[f"/room/wall_{row}"] for row in range(4)]
    assert all(node.side == "front" for node in walls) and not fake.nodes["/grid"].visible
    for node, wall in zip(walls, shell_of(ROOM).walls, strict=True):
        # All faces lie in the plane of the inner face: no reveal of the door stays by itself.
        vertices, faces = node.values
        beyond = (vertices[faces][..., [0, 2]] - wall.start_m) @ wall.outward
        assert len(faces) and np.abs(beyond).max() < 1e-6
    assert (fake.nodes["/room/ceiling"].values[0][:, 1] >= 2.6).all()
    assert drawn(FakeScene(), ROOM, "floor") == {"/grid", "floor", "object_0"}


def test_a_ray_hits_the_board_where_a_dot_is(fake, torch_rng, rng):
    cube = LatentCube(5)
    latent_map = make_map(cube, cube(torch.randn(9, 5, generator=torch_rng)))
    board = pages.Board(SimpleNamespace(scene=fake), latent_map, 4.0, lambda *_: None)
    center_m = fake.nodes["/map"].position
    dots_m = board.on_board(latent_map.rooms)
    w, x, y, z = fake.nodes["/map"].wxyz  # by which viser turns the board
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    np.testing.assert_allclose(board.in_scene(dots_m), dots_m @ turn.T + center_m, atol=1e-12)
    for dot, place in zip(board.in_scene(dots_m), latent_map.rooms.tolist(), strict=True):
        eye = rng.uniform([-3, 3, 3], [3, 6, 8])
        np.testing.assert_allclose(board.hit(eye, 0.3 * (dot - eye)), place, atol=1e-6)  # float32
    # Beside the board, its edge is hit; away from it, nothing.
    beside = board.in_scene(np.array([[40.0, 0.0, 0.0]]))[0]
    at_x, _ = board.hit(eye, beside - eye)
    assert at_x == pytest.approx(latent_map.middle[0] + latent_map.side / 2)
    assert board.hit(eye, eye - center_m) is None and board.hit(eye, [1.0, 0.0, 0.0]) is None


def test_models_come_and_go():
    with serving("127.0.0.1", 0) as server:
        page = open_page(server, Folder([ROOM]), "rooms").page
        page.display.models = True
        page.show(page.shown)
        assert page.scene.extra["retrieval"] and page.scene.objects[0].mesh is not None
        page.display.models = False
        page.show(page.shown)
        assert page.scene.objects == ROOM.objects


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
