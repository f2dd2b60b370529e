"""The browser that tests of pages use draws WebGL, and says what it was refused."""

from pathlib import Path


def test_the_browser_draws_webgl_and_reports_refused_requests(browser, tmp_path: Path):
    page = tmp_path / "page.html"
    page.write_text(
        '<!doctype html><meta http-equiv="Content-Security-Policy" content="default-src \'none\'">'
        '<img src="https://example.invalid/picture.png">'
    )
    browser.get(page.as_uri())
    has_webgl = "return !!document.createElement('canvas').getContext('webgl2')"
    assert browser.execute_script(has_webgl)
    assert "picture.png" in " ".join(entry["message"] for entry in browser.get_log("browser"))
