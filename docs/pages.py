"""Photographs our pages for docs/gallery.md: ``python docs/pages.py DEMO``, a folder of the demo.

    fragprune demo --out DEMO
    python docs/pages.py DEMO

It needs the extra [browser] and a Chromium. Each page is opened on a desktop, dark, and on a phone.
"""

from __future__ import annotations

import contextlib
import io
import sys
import tempfile
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from gallery import GALLERY, fragprune
from PIL import Image
from playwright.sync_api import sync_playwright

CHROMIUM = "/usr/bin/chromium"
SCREENS = {
    "desktop": {"viewport": {"width": 1280, "height": 800}},
    "dark": {"viewport": {"width": 1280, "height": 800}, "color_scheme": "dark"},
    "phone": {"viewport": {"width": 390, "height": 800}, "is_mobile": True, "has_touch": True},
}
HEIGHT = 480
"""Of a screen in the gallery, pixels."""


def main(demo: Path) -> None:
    """The pages of the demo, of its report, of an audit, and of the viewer."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        trained = min((demo / "model").rglob("point_cloud.ply"), key=lambda path: path.parent.name)
        fragprune("audit", trained, "--data", demo / "scene", "--out", folder / "audit")
        report = folder / "report.html"
        fragprune("report", demo / "model", "--data", demo / "scene", "--out", report)
        fragprune("view", demo, "--out", folder / "view")
        pages = {
            "demo": demo / "index.html",
            "audit": next((folder / "audit").glob("*.html")),
            "report": report,
            "view": folder / "view" / "index.html",
        }
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(
                executable_path=CHROMIUM, args=["--use-gl=swiftshader", "--no-sandbox"]
            )
            for page, path in pages.items():
                with served(path.parent) as address:
                    shots = [
                        photograph(browser, f"{address}/{path.name}", screen)
                        for screen in SCREENS.values()
                    ]
                abreast(GALLERY / f"page_{page}.jpg", shots)
            browser.close()


def photograph(browser: Any, address: str, screen: dict[str, Any]) -> Image.Image:
    """The first screen of a page, once it is at rest."""
    page = browser.new_context(**screen).new_page()
    page.goto(address)
    page.wait_for_timeout(4000)
    page.wait_for_function("() => !window.viewer || viewer.counted", timeout=200_000)
    image = Image.open(io.BytesIO(page.screenshot(timeout=200_000))).convert("RGB")
    page.context.close()
    return image


def abreast(path: Path, screens: list[Image.Image]) -> None:
    """Screens of equal height, a little apart."""
    gap, scaled = 8, [each.resize((each.width * HEIGHT // each.height, HEIGHT)) for each in screens]
    sheet = Image.new("RGB", (sum(e.width + gap for e in scaled) - gap, HEIGHT), "white")
    x = 0
    for each in scaled:
        sheet.paste(each, (x, 0))
        x += each.width + gap
    sheet.save(path, quality=78, optimize=True)


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    """A folder at an address of this machine."""
    handler = partial(SimpleHTTPRequestHandler, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
