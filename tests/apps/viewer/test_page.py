"""The panel shows names out of files as they are: no HTML, no Markdown, no file of this machine."""

import pytest

from sceneprior.apps.viewer.explorer import Folder
from sceneprior.core.scene import Scene, SceneObject

pytest.importorskip("viser", reason="the extra `view` is not installed")

from sceneprior.apps.viewer.page import Page, _html
from sceneprior.apps.viewer.server import serving

CLASS = "<img src=x onerror='hacked=1'>"
NAME = "![](_icons/tabler-icons.zip) <iframe srcdoc='<script>parent.hacked=1</script>'>"


def hostile_room() -> Scene:
    """A room as a stranger may send it."""
    item = SceneObject(CLASS, (0.0, 0.5, 0.0), (1.0, 1.0, 1.0))
    return Scene(NAME, f"void,{CLASS}", (item,))


def test_names_are_escaped_and_read_no_file(recwarn):
    with serving("127.0.0.1", 0) as server:
        page = Page(server, Folder([hostile_room()]), CLASS)
        said = page._said.content
        page.show(page.shown.toggled(0))
        kept = page._said.content
    assert not [warning for warning in recwarn if "image" in str(warning.message)]
    for content in (said, kept):
        assert "&lt;img src=x onerror=&#39;hacked=1&#39;&gt; 1.00 x 1.00 x 1.00 m" in content
        assert "<img" not in content and "<iframe" not in content and "![]" in content


def test_other_texts_of_the_panel_are_escaped_too():
    """The nearest training room's id, for example, is a text out of the run's files."""
    assert CLASS not in _html(CLASS) and "&lt;img" in _html(CLASS)
