"""Take the picture of `sceneprior view` on docs/uses.md (needs chromium, its driver, selenium).

python docs/draw_view.py docs/images/view.png
"""

import argparse
import io
import shutil
import sys
import time
from pathlib import Path

from PIL import Image

import sceneprior
from sceneprior.apps.viewer.explorer import Explorer
from sceneprior.apps.viewer.panel import open_page
from sceneprior.apps.viewer.server import serving

ASKED = {
    "floor": "0,0 4.6,0 4.6,3 2.4,3 2.4,4.4 0,4.4", "openings": "door@5:3.6, window@0:2",
    "want": "a double bed and two nightstands beside it, a desk and no sofa",
}  # fmt: skip
WIDTH_PX, HEIGHT_PX = 1280, 1060
SETTLED_S = 20
"""Time for nodes to arrive and shadows to be drawn; WebGL is drawn in software."""
CLOSE = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(x => x.click())"


def main() -> None:
    """Take the picture."""
    options = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    options.add_argument("out", type=Path)
    options.add_argument("--prior", default="procthor-bedroom")
    given = options.parse_args()
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from browser import FLAGS, picture
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    chrome = webdriver.ChromeOptions()
    chrome.binary_location = shutil.which("chromium") or ""
    for flag in FLAGS:
        chrome.add_argument(flag)
    driver = webdriver.Chrome(chrome, Service(shutil.which("chromedriver")))
    try:
        with serving("127.0.0.1", 0) as server:
            open_page(server, Explorer(sceneprior.load(given.prior)), given.prior, asked=ASKED)
            driver.set_window_size(WIDTH_PX, HEIGHT_PX)
            driver.get(f"http://127.0.0.1:{server.get_port()}")
            time.sleep(SETTLED_S)
            driver.execute_script(CLOSE)
            time.sleep(1)
            shown = picture(driver.get_screenshot_as_png)
    finally:
        driver.quit()
    buffer = io.BytesIO()
    shown.quantize(255, dither=Image.Dither.NONE).save(buffer, format="PNG", optimize=True)
    given.out.write_bytes(buffer.getvalue())


if __name__ == "__main__":
    main()
