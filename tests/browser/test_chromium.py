"""What all tests of pages stand on."""

import numpy as np
import pytest
from browser.chromium import opened, served

pytestmark = pytest.mark.browser

PAGE = """<!doctype html><title>red</title><link rel="icon" href="data:,">
<canvas width="8" height="4"></canvas>
<script type="module">
import { paint } from "./paint.js";
window.pixels = paint(document.querySelector("canvas"));
</script>"""

PAINT = """export function paint(canvas) {
    const gl = canvas.getContext("webgl2");
    gl.clearColor(1, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    const pixels = new Uint8Array(4 * 8 * 4);
    gl.readPixels(0, 0, 8, 4, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    return pixels;
}"""


@pytest.fixture
def page(tmp_path):
    (tmp_path / "index.html").write_text(PAGE)
    (tmp_path / "paint.js").write_text(PAINT)
    with served(tmp_path) as address:
        yield address


def test_webgl2_draws_red_and_names_its_renderer(browser, page):
    with opened(browser, page) as tab:
        assert (tab.array("window.pixels").reshape(-1, 4) == (255, 0, 0, 255)).all()
        shown = tab.picture("canvas")
        assert shown.shape == (4, 8, 3)
        assert np.abs(shown.astype(int) - (255, 0, 0)).max() <= 1
        assert "SwiftShader" in tab.renderer()
        assert tab.errors == tab.strangers == []


def test_errors_are_heard_and_strangers_get_no_answer(browser, page):
    with opened(browser, page) as tab:
        tab.run("() => console.error('told')")
        tab.run("() => fetch('http://example.invalid/x').catch(() => 0)")
        tab.run("() => fetch('/absent').then(() => 0)")
        assert tab.strangers == ["http://example.invalid/x"]
        assert any("told" in each for each in tab.errors)
        assert any("404" in each for each in tab.errors)
