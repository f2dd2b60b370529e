"""The page in a real browser: it draws, the room follows the pointer, and buttons do their work."""

import contextlib
import time
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from browser import picture, wait_for

import sceneprior
from sceneprior.apps.viewer.explorer import Explorer, Folder
from sceneprior.core.scene import Scene, SceneObject

pytest.importorskip("viser", reason="the extra `view` is not installed")

from sceneprior.apps.viewer.panel import Panel, open_page
from sceneprior.apps.viewer.server import serving

pytestmark = pytest.mark.slow


def words(browser) -> str:
    return browser.find_element("css selector", "body").text


def on_screen(page, point_m) -> tuple[float, float]:
    """Where a point of the scene is, in pixels of the one client's canvas."""
    (client,) = page.server.get_clients().values()
    camera = client.camera
    w, x, y, z = camera.wxyz
    forward = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    right = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
    down = np.cross(forward, right)
    away = np.asarray(point_m) - camera.position
    scale = camera.image_height / 2 / np.tan(camera.fov / 2) / (away @ forward)
    return (
        camera.image_width / 2 + scale * (away @ right),
        camera.image_height / 2 + scale * (away @ down),
    )


def canvas(browser) -> np.ndarray:
    """What is drawn left of the panel."""
    shown = picture(browser.get_screenshot_as_png)
    return np.asarray(shown.crop((0, 0, int(0.65 * shown.width), shown.height))).astype(int)


def click(browser, text: str) -> None:
    browser.find_element("xpath", f"//*[text()='{text}']").click()


@contextlib.contextmanager
def opened(browser, source, title: str, **more) -> Iterator[Panel]:
    """A page in the browser, once its room is framed."""
    with serving("127.0.0.1", 0) as server:
        panel = open_page(server, source, title, **more)
        server.scene.configure_default_lights(cast_shadow=False)  # half of the time in software
        browser.set_window_size(1000, 700)
        browser.get_log("browser")
        browser.get(f"http://127.0.0.1:{server.get_port()}")
        wait_for(lambda: "Whole room in view" in words(browser), "no panel came")
        wait_for(server.get_clients, "the browser did not connect")
        # viser warns that WebGL is drawn in software, right over the board.
        close = "document.querySelectorAll('.mantine-Notification-closeButton')"
        browser.execute_script(f"{close}.forEach(x => x.click())")
        yield panel
        browser.get("about:blank")


@pytest.fixture(scope="module")
def page(browser, toy_run):
    with opened(browser, Explorer(sceneprior.load(toy_run)), "toy rooms") as panel:
        yield panel.page


def test_the_room_follows_the_pointer(browser, page, monkeypatch):
    from selenium.webdriver import ActionChains

    assert "seed 0, from: paper" in words(browser)
    wait_for(lambda: len(np.unique(canvas(browser) // 32)) > 4, "nothing is drawn")
    before = canvas(browser)
    latent_map = page.board.latent_map
    places = [
        (latent_map.middle[0] + t * latent_map.side, latent_map.middle[1] - t * latent_map.side)
        for t in np.linspace(-0.3, 0.3, 7)
    ]
    shown = []
    show = page.show

    def noted(room, settled=True):
        show(room, settled)
        shown.append((room, settled))

    monkeypatch.setattr(page, "show", noted)
    points_m = page.board.in_scene(page.board.on_board(torch.tensor(places)))
    points = [on_screen(page, point_m) for point_m in points_m]
    # Step by step: of a browser that is slow to draw, a gesture at once is over before it is seen.
    for number, (x, y) in enumerate(points):
        mouse = ActionChains(browser, duration=50)
        mouse.w3c_actions.pointer_action.move_to_location(int(x), int(y))
        if number == 0:
            mouse.w3c_actions.pointer_action.pointer_down()
        mouse.perform()
        time.sleep(0.1)
    wait_for(lambda: shown, "no room followed the pointer")
    ActionChains(browser).release().perform()
    wait_for(lambda: shown[-1][1], "the drag did not end in a room")
    last = shown[-1][0]
    found = latent_map.place(torch.from_numpy(last.scene.latent)[None])[0]
    # A pixel is 0.3% of the board; the room is where the pointer was let go.
    np.testing.assert_allclose(found, places[-1], atol=0.02 * latent_map.side)
    wait_for(lambda: last.origin in words(browser), "the panel does not say so")
    wait_for(lambda: (np.abs(canvas(browser) - before).max(axis=-1) > 40).any(), "nothing moved")
    # viser's own way of handling touches makes chromium complain, once a drag.
    log = [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]
    assert [said for said in log if "passive event listener" not in said] == []


def test_a_request_is_typed_answered_completed_and_downloaded(browser, tmp_path):
    from selenium.webdriver import ActionChains

    source, asked = Explorer(sceneprior.load("procthor-bedroom")), {"want": "two nightstands"}
    with opened(browser, source, "rooms", asked=asked) as panel:
        page = panel.page
        for label, text in (("Floor", "5x4"), ("Doors", "door@3:1.2")):
            field = f"//label[text()='{label}']/following::input[1]"
            browser.find_element("xpath", field).send_keys(text)
        wait_for(lambda: panel.request.text("openings") == "door@3:1.2", "nothing was typed")
        click(browser, "Make room")
        wait_for(lambda: page.scene.openings, "no room was made")
        wait_for(
            lambda: "1 door" in words(browser) and "✓ 2 nightstand" in words(browser), "silence"
        )
        np.testing.assert_allclose(np.ptp(page.scene.floor_m, axis=0), [5, 4])
        item = page.shown.scene.objects[0]
        x, y = on_screen(page, np.add(item.center_m, (0, item.size_m[1] / 2, 0)))
        mouse = ActionChains(browser)
        mouse.w3c_actions.pointer_action.move_to_location(int(x), int(y)).click()
        mouse.perform()
        wait_for(lambda: page.shown.kept, "no object is kept")
        (row,) = page.shown.kept
        kept = page.shown.scene.objects[row]
        click(browser, "Complete the rest")
        wait_for(lambda: "completed around 1 kept objects" in words(browser), "not completed")
        assert page.shown.scene.objects[0].center_m == kept.center_m
        folder = {"behavior": "allow", "downloadPath": str(tmp_path)}
        browser.execute_cdp_cmd("Page.setDownloadBehavior", folder)
        button = browser.find_element("xpath", "//button[.//text()='Download']")
        browser.execute_script("arguments[0].scrollIntoView(); arguments[0].click()", button)
        file = tmp_path / f"{page.scene.name}.glb"
        wait_for(file.is_file, "no file came")
        assert b"wall_3" in file.read_bytes()


def test_a_room_of_a_stranger_runs_nothing(browser):
    name = "<iframe srcdoc='<script>parent.hacked=1</script>'>"
    label = "<img src=x onerror=hacked=1>"
    item = SceneObject(label, (0.0, 0.5, 0.0), (1.0, 1.0, 1.0))
    with opened(browser, Folder([Scene(name, f"void,{label}", (item,))]), label) as panel:
        wait_for(lambda: name in words(browser), "the room's name is not shown as it is")
        click(browser, "Names and sizes")
        wait_for(lambda: words(browser).count(label) >= 2, "class and title are not shown")
        assert panel.page.display.names
        assert browser.execute_script("return window.hacked") is None
        strange = "x => !x.src.startsWith('data:')"
        count = f"[...document.querySelectorAll('img, iframe')].filter({strange}).length"
        assert browser.execute_script(f"return {count}") == 0
