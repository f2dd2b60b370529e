"""A real browser for tests of pages: Debian's chromium without a window, driven by selenium.

`tests/conftest.py` makes the fixture known. Tests skip where there is no chromium, and say so.
"""

import contextlib
import io
import shutil
import time
from collections.abc import Callable, Iterator

import pytest
from PIL import Image

FLAGS = (
    "--headless=new",
    "--no-sandbox",  # which containers and root cannot have
    "--disable-dev-shm-usage",  # small in containers
    "--use-gl=angle",
    "--use-angle=swiftshader",  # WebGL without a GPU
    "--enable-unsafe-swiftshader",
    "--window-size=1280,1000",
)


def wait_for(condition: Callable[[], object], said: str, seconds: float = 600) -> None:
    """WebGL in software takes long, on a machine that does other things as well."""
    limit = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < limit, said
        time.sleep(0.1)


def picture(take: Callable[[], bytes]) -> Image.Image:
    """The image in a PNG of the browser; Chromium gives up on a screenshot after 10 s."""
    from selenium.common.exceptions import TimeoutException

    for _ in range(6):
        with contextlib.suppress(TimeoutException):
            return Image.open(io.BytesIO(take())).convert("RGB")
    raise AssertionError("the browser gives no picture")


@pytest.fixture(scope="session")
def browser() -> Iterator:
    """A Chromium that all tests of a process share, since it starts slowly; WebGL is drawn in
    software. Its log (`browser.get_log("browser")`) lists what pages wrote and which requests were
    refused."""
    programs = {name: shutil.which(name) for name in ("chromium", "chromedriver")}
    if None in programs.values():
        pytest.skip("no chromium here: apt-get install chromium chromium-driver")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = programs["chromium"]
    for flag in FLAGS:
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options, Service(programs["chromedriver"]))
    driver.set_script_timeout(60)
    yield driver
    driver.quit()
