"""Pages of turning rooms: opened from disk in a real browser, and without scripts or WebGL."""

import base64
import hashlib
import io
import json
import re
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import picture, wait_for
from PIL import Image

import sceneprior.evaluation
from sceneprior.core.scene import Mesh, Opening, Scene, SceneObject
from sceneprior.core.surfaces import surface_of
from sceneprior.evaluation.page import (
    glb_of,
    write_rooms_page,
)

VIEWER = Path(sceneprior.evaluation.__file__).parent / "model_viewer"
WITHOUT_WEBGL = """
const asked = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
  return kind.startsWith("webgl") ? null : asked.call(this, kind, ...more);
};
"""


def bedroom(name: str = "mine") -> Scene:
    ball = 4 - 10 * np.linalg.norm(np.stack(np.mgrid[-1:1:32j, -1:1:32j, -1:1:32j]), axis=0) / 2
    size_m = (0.6, 0.6, 0.6)
    surface = Mesh(*surface_of(ball, np.array([1.2, 0.4, 0.0]), np.array(size_m)))
    return Scene(
        name,
        "front3d_bedroom",
        (
            SceneObject("double_bed", (-0.5, 0.3, 0.4), (1.8, 0.6, 2.0)),
            SceneObject("stool", (1.2, 0.4, 0.0), size_m, surface),
        ),
    )


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("page") / "rooms.html"
    rooms = [bedroom(), replace(bedroom("<other>"), objects=())]
    write_rooms_page(path, rooms, title="Rooms & more", subtitle="made by hand")
    return path


def picture_of(browser) -> np.ndarray:
    """The browser's picture of the first room."""
    room = browser.find_element("css selector", "model-viewer")
    return np.asarray(picture(lambda: room.screenshot_as_png)).astype(int)


def settled(browser) -> np.ndarray:
    """The picture once it no longer changes."""
    before, now = None, picture_of(browser)
    while before is None or not np.array_equal(before, now):
        time.sleep(0.5)
        before, now = now, picture_of(browser)
    return now


def colors_of(picture: np.ndarray) -> int:
    return len(np.unique((picture // 16).reshape(-1, 3), axis=0))


def test_a_room_turns_under_the_mouse(browser, page, tmp_path):
    from selenium.webdriver import ActionChains

    browser.get_log("browser")
    browser.get(page.as_uri())
    room = browser.find_element("css selector", "model-viewer")
    loaded = "return arguments[0].loaded === true"
    wait_for(lambda: browser.execute_script(loaded, room), "the room was not loaded")
    before = settled(browser)
    assert colors_of(before) > 8  # a room, and no blank canvas
    turned = "return arguments[0].getCameraOrbit().theta"
    angle = browser.execute_script(turned, room)
    ActionChains(browser).drag_and_drop_by_offset(room, 80, 0).perform()
    after = settled(browser)
    assert abs(browser.execute_script(turned, room) - angle) > 0.3
    assert (np.abs(after - before).max(axis=-1) > 40).mean() > 0.05  # of all pixels
    browser.save_screenshot(str(tmp_path / "turned.png"))
    # Nothing was asked of any network, and nothing was refused.
    requests = "return performance.getEntriesByType('resource').map(entry => entry.name)"
    assert all(name[:5] in ("data:", "blob:") for name in browser.execute_script(requests))
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


@pytest.mark.parametrize("missing", ["JavaScript", "WebGL"])
def test_pictures_stay_where_something_is_missing(browser, page, missing):
    if missing == "JavaScript":
        browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
    else:
        script = browser.execute_cdp_cmd(
            "Page.addScriptToEvaluateOnNewDocument", {"source": WITHOUT_WEBGL}
        )
    try:
        browser.get(page.as_uri())
        shown = picture_of(browser)
        assert colors_of(shown) > 8
        poster = re.search(r'slot="poster" src="data:image/jpeg;base64,([^"]+)"', page.read_text())
        given = Image.open(io.BytesIO(base64.b64decode(poster[1])))
        given = np.asarray(given.resize(shown.shape[1::-1])).astype(int)
        assert np.abs(given - shown).mean() < 8  # scaled, another way
    finally:
        if missing == "JavaScript":
            browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})
        else:
            browser.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", script)


def test_walls_of_a_model_are_seen_from_inside_only():
    outline = np.array([[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]])
    door = Opening("door", (-0.5, -2.0), (0.5, -2.0), 0.0, 2.0)
    room = replace(bedroom(), floor_m=outline)
    for walled in (
        glb_of(replace(room, openings=(door,)), 300, "none"),
        glb_of(room, 300, "walls"),
    ):
        model = json.loads(walled[20 : 20 + int.from_bytes(walled[12:16], "little")])
        sides = {each["name"]: each.get("doubleSided", False) for each in model["materials"]}
        assert not sides["wall"] and not sides["ceiling"] and sides["double_bed"]
    assert b"wall_0" not in glb_of(room, 300, "none")


def test_the_viewer_is_what_its_page_says():
    told = re.search(r"`([0-9a-f]{64})`", (VIEWER / "README.md").read_text())
    script = (VIEWER / "model-viewer-umd.min.js").read_bytes()
    assert told is not None and hashlib.sha256(script).hexdigest() == told[1]
    assert b"</script" not in script
