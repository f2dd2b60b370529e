"""A real browser for tests of pages: Debian's chromium without a window, driven by selenium.

`tests/conftest.py` makes the fixture known. Tests skip where there is no chromium, and say so.
"""

import shutil
from collections.abc import Iterator

import pytest

FLAGS = (
    "--headless=new",
    "--no-sandbox",  # which containers and root cannot have
    "--disable-dev-shm-usage",  # small in containers
    "--use-gl=angle",
    "--use-angle=swiftshader",  # WebGL without a GPU
    "--enable-unsafe-swiftshader",
    "--window-size=1280,1000",
)


@pytest.fixture(scope="session")
def browser() -> Iterator["webdriver.Chrome"]:
    """One chromium for all tests of a process, for it starts slowly; WebGL is drawn in software.

    Its log (`browser.get_log("browser")`) holds what pages wrote and which requests were refused.
    """
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
