"""The panel shows names out of files as they are, answers requests, and offers furniture."""

import numpy as np
import pytest

import sceneprior
from sceneprior.apps.viewer.explorer import Explorer, Folder
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene, SceneObject

pytest.importorskip("viser", reason="the extra `view` is not installed")

from sceneprior.apps.viewer.page import Page
from sceneprior.apps.viewer.panel import DECODED, MODELS
from sceneprior.apps.viewer.server import serving
from sceneprior.apps.viewer.words import error_words, html, wish_words

CLASS = "<img src=x onerror='hacked=1'>"
NAME = "![](_icons/tabler-icons.zip) <iframe srcdoc='<script>parent.hacked=1</script>'>"


def hostile_room() -> Scene:
    """A room as a stranger may send it."""
    item = SceneObject(CLASS, (0.0, 0.5, 0.0), (1.0, 1.0, 1.0))
    return Scene(NAME, f"void,{CLASS}", (item,))


def test_names_are_escaped_and_read_no_file(recwarn):
    with serving("127.0.0.1", 0) as server:
        page = Page(server, Folder([hostile_room()]), CLASS)
        said = page.panel._said.content
        page.show(page.shown.toggled(0))
        kept = page.panel._said.content
    assert not [warning for warning in recwarn if "image" in str(warning.message)]
    for content in (said, kept):
        assert "&lt;img src=x onerror=&#39;hacked=1&#39;&gt; 1.00 x 1.00 x 1.00 m" in content
        assert "<img" not in content and "<iframe" not in content and "![]" in content


def test_other_texts_of_the_panel_are_escaped_too():
    """The nearest training room's id, for example, is a text out of the run's files."""
    wishes = [{"wish": CLASS, "holds": True}, {"wish": CLASS, "holds": "<b>"}, CLASS, None]
    room = Scene(NAME, "front3d_bedroom", extra={"wishes": wishes})
    for text in (CLASS, error_words(CLASS), wish_words(room)):
        assert CLASS not in html(text) and "&lt;img" in html(text)
    assert html(wish_words(room)).count("not fulfilled") == 1
    for other in (None, {}, CLASS, [], 3):
        assert not wish_words(Scene(NAME, "front3d_bedroom", extra={"wishes": other}))


@pytest.fixture(scope="module")
def prior():
    return sceneprior.load("procthor-bedroom")


def test_fields_of_a_request_read_no_file(prior, tmp_path):
    """A floor's file may be named on the command line, never in the browser."""
    (tmp_path / "floor.json").write_text("[[0, 0], [4, 0], [4, 3], [0, 3]]")
    with serving("127.0.0.1", 0) as server:
        page = Page(server, Explorer(prior), "prior")
        fields = page.panel._fields
        for text in (f"{tmp_path}/floor.json", f"{tmp_path}/floor.json:room", "floor.npz"):
            fields.floor.value = text
            with pytest.raises(InputError, match="expected its size in metres"):
                fields.asked()


def test_a_request_is_answered_or_refused_in_the_panel(prior):
    asked = {"floor": np.array([[0, 0], [4, 0], [4, 3], [0, 3]]), "want": {"nightstand": 2}}
    with serving("127.0.0.1", 0) as server:
        page = Page(server, Explorer(prior), "prior", asked=asked)
        panel, fields = page.panel, page.panel._fields
        assert fields.floor.value == "0,0 4,0 4,3 0,3"
        assert "The command also requests: want." in fields._rest_said.content
        assert "✓ 2 nightstand" in panel._answer.content
        fields.want.value, fields.openings.value = "double_bed: 1", "door@south"
        panel._sample(page.explorer, 1, None)
        assert page.shown.origin == "seed 1, from: sampler, as requested"
        assert "✓ 1 double bed" in panel._answer.content
        same = prior.sample(
            1, 1, floor=asked["floor"], openings="door@south", want={"double_bed": 1}
        )[0]
        assert page.scene.without_meshes().objects == same.without_meshes().objects
        assert page.scene.openings == same.openings
        assert "Floor: 4.00 x 3.00 m, 1 door" in panel._said.content
        shown = page.shown
        fields.want.value = "a purple bed"
        page.safely(lambda: panel._sample(page.explorer, 1, None))
        assert "not understood: &#39;purple&#39;" in panel._answer.content
        assert page.shown is shown
        fields._emptied()
        assert fields.asked() == {} and fields._rest_said.visible is False
        fields.ceiling.value = "high"
        with pytest.raises(InputError, match="ceiling is 'high'; expected its height"):
            fields.asked()
        fields.ceiling.value = "2.4 m"
        assert fields.asked() == {"ceiling_m": 2.4}
        with pytest.raises(InputError, match="Rooms from paper answer no requests; choose sampler"):
            page.explorer.sample(0, "paper", fields.asked())


def test_models_come_and_go():
    bed = SceneObject("double_bed", (0.0, 0.5, 0.0), (2.0, 1.0, 2.2))
    with serving("127.0.0.1", 0) as server:
        page = Page(server, Folder([Scene("room", "front3d_bedroom", (bed,))]), "rooms")
        assert page.scene.objects == (bed,)
        page.panel.furniture.value = MODELS
        page.show(page.shown)
        (found,) = page.scene.extra["retrieval"]
        assert found["model_id"].startswith("double_bed_")
        assert page.scene.objects[0].mesh is not None
        page.panel.furniture.value = DECODED
        page.show(page.shown)
        assert page.scene.objects == (bed,)
