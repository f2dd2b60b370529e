"""The page in a real browser: each action of docs/uses.md, clicked through."""

import contextlib
import time
from collections.abc import Iterator

import numpy as np
import pytest
from browser import picture, wait_for

import sceneprior
from sceneprior.apps.viewer.explorer import Explorer
from sceneprior.apps.viewer.shown import Folder
from sceneprior.core.scene import Scene, SceneObject

pytest.importorskip("viser", reason="the extra `view` is not installed")

from sceneprior.apps.viewer.panel import Panel, open_page
from sceneprior.apps.viewer.server import serving

pytestmark = pytest.mark.slow
SIZES = {"desktop": (1280, 800), "phone": (390, 844)}


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


def click(browser, text: str) -> None:
    """Click the last control with this text, wherever the panel is scrolled to."""
    found = browser.find_elements("xpath", f"//*[contains(text(), '{text}')]")
    browser.execute_script("arguments[0].click()", found[-1])


def open_tab(browser, name: str) -> None:
    """Click a tab with the pointer, since viser's tabs can be dragged, too."""
    (tab,) = browser.find_elements("xpath", f"//*[text()='{name}']")
    tab.click()
    time.sleep(0.5)


def move(browser, points) -> None:
    """Lead the pointer over points of the window, with its button pressed. Step by step: of a
    browser that is slow to draw, a gesture at once is over before it is seen."""
    from selenium.webdriver import ActionChains

    for number, (x, y) in enumerate(points):
        mouse = ActionChains(browser, duration=50)
        mouse.w3c_actions.pointer_action.move_to_location(int(x), int(y))
        if number == 0:
            mouse.w3c_actions.pointer_action.pointer_down()
        mouse.perform()
        time.sleep(0.2)
    ActionChains(browser).release().perform()


@contextlib.contextmanager
def opened(browser, source, title: str, size: str = "desktop", **more) -> Iterator[Panel]:
    """A page in the browser, once its room is framed."""
    width, height = SIZES[size]
    with serving("127.0.0.1", 0) as server:
        panel = open_page(server, source, title, **more)
        panel.page.sun.cast_shadow = False  # half of the time in software
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        browser.get_log("browser")
        browser.get(f"http://127.0.0.1:{server.get_port()}")
        wait_for(lambda: "Walk in" in words(browser), "no panel came")
        wait_for(server.get_clients, "the browser did not connect")
        # viser warns that WebGL is drawn in software, right over the room.
        close = "document.querySelectorAll('.mantine-Notification-closeButton')"
        browser.execute_script(f"{close}.forEach(x => x.click())")
        yield panel
        browser.get("about:blank")
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_a_room_is_asked_for_changed_and_saved(browser, tmp_path):
    source = Explorer(sceneprior.load("procthor-bedroom"))
    asked = {"want": "a 4 x 3 m bedroom with a door and two nightstands"}
    with opened(browser, source, "rooms", asked=asked) as panel:
        page = panel.page
        first = page.shown
        for clause in ("a 4 x 3 m bedroom", "a door", "two nightstands"):
            assert f"✓ {clause}" in words(browser)
        # The documented command: its sentence names the floor, and the room has one by then.
        click(browser, "New room")
        wait_for(lambda: page.shown.origin.startswith("Room of seed 1"), "no new room")
        click(browser, "Undo")
        wait_for(lambda: page.shown == first, "not undone")

        field = browser.find_element("css selector", "textarea")
        field.send_keys(" beside a purple bed\n")
        wait_for(lambda: "not understood" in words(browser), "no error")
        assert words(browser).count("not understood") == 1 and page.shown == first
        browser.execute_script("arguments[0].select()", field)
        field.send_keys("4 x 3 m, a door, a double bed, two nightstands\n")
        wait_for(lambda: "✓ a double bed" in words(browser), "no room for the typed request")
        assert "not understood" not in words(browser)
        click(browser, "two nightstands")
        wait_for(lambda: page.shown.line == "4 x 3 m, a door, a double bed", "the clause stayed")
        click(browser, "Complete")
        wait_for(lambda: "No piece is locked" in words(browser), "nothing was said")

        row = [item.label for item in page.shown.scene.objects].index("double_bed")
        bed = page.shown.scene.objects[row]
        x, y = on_screen(page, bed.center_m)
        move(browser, [(x, y)])
        wait_for(lambda: page.shown.picked == row, "a click picks no piece")
        click(browser, "Lock this piece")
        wait_for(lambda: "Unlock this piece" in words(browser), "not locked")
        click(browser, "Complete")
        wait_for(lambda: "Completed around 1 locked piece" in words(browser), "not completed")
        assert page.shown.scene.objects[0].center_m == bed.center_m

        before = page.shown
        x, y = on_screen(page, bed.center_m)
        way = np.array(on_screen(page, (0.0, bed.center_m[1], 0.0))) - (x, y)
        move(browser, [(x, y) + way * t for t in (0, 0.2, 0.4, 0.6)])
        wait_for(lambda: page.shown.origin != before.origin, "the rest did not follow")
        moved = page.shown.scene.objects[0].center_m
        assert moved != bed.center_m and moved[1] == pytest.approx(bed.center_m[1])
        labels = [sorted(e.label for e in s.scene.objects) for s in (before, page.shown)]
        assert labels[0] == labels[1]
        click(browser, "Replace by model")
        wait_for(lambda: "retrieval" in page.shown.scene.extra, "no models")
        wait_for(lambda: "✓ a double bed" in words(browser), "no ticks")

        (client,) = page.server.get_clients().values()
        eyes = [client.camera.position.copy()]
        # What the browser reports, since the server changes its own state at once.
        client.camera.on_update(lambda camera: eyes.append(camera.position.copy()))
        for view in ("From above", "Walk in", "From outside"):
            eye = eyes[-1]
            click(browser, view)
            wait_for(lambda: np.abs(eyes[-1] - eye).max() > 0.5, f"not {view}")  # noqa: B023
        open_tab(browser, "Save")
        folder = {"behavior": "allow", "downloadPath": str(tmp_path)}
        browser.execute_cdp_cmd("Page.setDownloadBehavior", folder)
        click(browser, "Download")
        file = tmp_path / f"{page.shown.scene.name}.glb"
        wait_for(file.is_file, "no file came")
        assert b"wall_3" in file.read_bytes()


def test_the_room_follows_the_pointer_over_the_map_and_along_a_path(browser, toy_run):
    with opened(browser, Explorer(sceneprior.load(toy_run)), "toy rooms") as panel:
        page, latent_map = panel.page, panel.page.source.map
        assert "Room of seed 0, from paper" in words(browser)
        open_tab(browser, "Map")
        box = browser.find_element("css selector", "svg.sp-map").rect
        points = [
            (box["x"] + t * box["width"], box["y"] + t * box["height"]) for t in (0.3, 0.5, 0.7)
        ]
        move(browser, points)
        goal = [
            latent_map.middle[0] + 0.2 * latent_map.side,
            latent_map.middle[1] - 0.2 * latent_map.side,
        ]

        def at() -> np.ndarray:
            latent = page.shown.scene.latent
            return np.asarray(latent_map.axes) @ latent

        wait_for(lambda: np.abs(at() - goal).max() < 0.02 * latent_map.side, "not followed")
        open_tab(browser, "Room")
        wait_for(lambda: page.shown.origin in words(browser), "the panel does not say so")
        open_tab(browser, "Map")
        dot = browser.find_elements("css selector", "svg.sp-map circle")[5].rect
        move(browser, [(dot["x"] + dot["width"] / 2, dot["y"] + dot["height"] / 2)])
        wait_for(lambda: page.shown.origin.startswith("Training room"), "a dot is no room")
        open_tab(browser, "Path")
        click(browser, "Draw path")
        open_tab(browser, "Room")
        wait_for(lambda: "Path, step 0 of 48" in words(browser), "no path")
        open_tab(browser, "Map")
        assert browser.find_elements("css selector", "svg.sp-map polyline")
        log = [e["message"] for e in browser.get_log("browser") if e["level"] == "SEVERE"]
        assert [said for said in log if "passive event listener" not in said] == []


def test_on_a_phone_the_panel_is_a_drawer(browser):
    source = Explorer(sceneprior.load("demo-bedroom"))
    with opened(browser, source, "rooms", size="phone") as panel:
        drawer = browser.find_element("css selector", ".mantine-Paper-root[style*='fixed']").rect
        assert drawer["width"] == 390 and drawer["height"] <= 0.47 * 844
        wide = "return document.documentElement.scrollWidth"
        assert browser.execute_script(wide) == 390
        for example in source.examples:
            assert example in words(browser)

        def drawn() -> np.ndarray:
            shown = np.asarray(picture(browser.get_screenshot_as_png)).astype(int)
            return np.argwhere(
                np.abs(shown[: int(drawer["y"])] - (241, 239, 234)).sum(axis=-1) > 60
            )

        wait_for(lambda: len(drawn()) > 5000, "nothing is drawn")
        low, high = drawn().min(axis=0), drawn().max(axis=0)
        # The room fills the part above the drawer, and nothing of it is cut off or below.
        assert (high - low)[1] > 0.75 * 390 and low.min() > 2 and high[1] < 388
        assert high[0] < drawer["y"] - 5
        click(browser, "two single beds")
        wait_for(lambda: "✓ two single beds far from the door" in words(browser), "no room")
        assert panel.page.shown.scene.openings


def test_a_folder_of_a_stranger_is_shown_and_runs_nothing(browser):
    name = "<iframe srcdoc='<script>parent.hacked=1</script>'>"
    label = "<img src=x onerror=hacked=1>"
    item = SceneObject(label, (0.0, 0.5, 0.0), (1.0, 1.0, 1.0))
    rooms = [Scene(name + each, f"void,{label}", (item,)) for each in "ab"]
    with opened(browser, Folder(rooms), label) as panel:
        wait_for(lambda: name in words(browser), "the room's name is not shown as it is")
        assert words(browser).count(label) >= 2, "class and title are not shown"
        open_tab(browser, "View")
        click(browser, "Names and sizes")
        wait_for(lambda: panel.page.names, "no names are shown")
        assert browser.execute_script("return window.hacked") is None
        strange = "x => !x.src.startsWith('data:')"
        count = f"[...document.querySelectorAll('img, iframe')].filter({strange}).length"
        assert browser.execute_script(f"return {count}") == 0
