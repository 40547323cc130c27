"""A real Chromium without a window: folders served to it, and what its pages show and say.

with served(folder) as address, chromium() as browser, opened(browser, address) as tab:
    tab.page.click("#draw")            # everything that playwright's page can do
    tab.array("readPixels()")          # a typed array, as NumPy's
    tab.picture("canvas")              # what is on the screen there
    assert tab.errors == []
"""

import base64
import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from PIL import Image

EXECUTABLE = Path("/usr/bin/chromium")
"""Debian's. No browser is ever downloaded."""

FLAGS = (
    *("--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--use-angle=swiftshader"),
    *("--enable-unsafe-swiftshader", "--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader"),
    *("--enable-features=Vulkan", "--use-vulkan=swiftshader"),
)


def missing() -> str | None:
    """Why no page can be opened here; None if one can."""
    if not EXECUTABLE.exists():
        return f"no {EXECUTABLE} here"
    try:
        import playwright  # noqa: F401
    except ImportError:
        return "no playwright here: pip install fragprune-plugins[browser]"
    return None


class _Handler(SimpleHTTPRequestHandler):
    extensions_map = {  # noqa: RUF012
        **SimpleHTTPRequestHandler.extensions_map,
        ".js": "text/javascript",
        ".mjs": "text/javascript",
        ".wasm": "application/wasm",
    }

    def log_message(self, *words: Any) -> None:
        """Say nothing."""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder on this machine; its address, ending in a slash."""
    handler = partial(_Handler, directory=str(folder))
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@contextmanager
def chromium(*flags: str) -> Iterator[Any]:
    """Start Chromium, by these flags and ``FLAGS``, with an empty profile; playwright's browser."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=EXECUTABLE, args=[*FLAGS, *flags])
        try:
            yield browser
        finally:
            browser.close()


@dataclass
class Tab:
    """One open page; what went wrong in it; the addresses beyond its origin that it asked in vain.

    Playwright's ``wait_for_function`` needs a function: a page's policy allows no other string.
    """

    page: Any
    errors: list[str] = field(default_factory=list)
    strangers: list[str] = field(default_factory=list)

    def run(self, expression: str, argument: Any = None) -> Any:
        """The value of a JavaScript expression, or of the promise it gives."""
        return self.page.evaluate(expression, argument)

    def array(self, expression: str) -> np.ndarray:
        """The typed array that a JavaScript expression gives, (count,)."""
        kind, encoded = self.page.evaluate(
            f"""async () => {{
                const array = await ({expression});
                const bytes = new Uint8Array(array.buffer, array.byteOffset, array.byteLength);
                const parts = [];
                for (let i = 0; i < bytes.length; i += 32768)
                    parts.push(String.fromCharCode(...bytes.subarray(i, i + 32768)));
                return [array.constructor.name, btoa(parts.join(""))];
            }}"""
        )
        kind = kind.removesuffix("Array").removesuffix("Clamped").lower()
        return np.frombuffer(base64.b64decode(encoded), np.dtype(kind))

    def picture(self, selector: str | None = None) -> np.ndarray:
        """What the screen shows of the page or of one element, (H, W, 3) uint8."""
        part = self.page if selector is None else self.page.locator(selector)
        image = Image.open(io.BytesIO(part.screenshot()))
        return np.asarray(image.convert("RGB"))

    def renderer(self) -> str:
        """Who draws WebGL here, by its own name."""
        name: str = self.run(
            """() => {
                const gl = document.createElement("canvas").getContext("webgl2");
                const info = gl.getExtension("WEBGL_debug_renderer_info");
                return gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
            }"""
        )
        return name


@contextmanager
def opened(browser, address, *, width=1280, height=720, **context):
    """Open a page that gets nothing from anywhere but its own origin, in CSS pixels.

    ``context`` goes to playwright's ``new_context``, as ``color_scheme="dark"``.
    """
    home = urlsplit(address)[:2]
    held = browser.new_context(viewport={"width": width, "height": height}, **context)
    tab = Tab(held.new_page())

    def answer(route: Any) -> None:
        url = route.request.url
        if urlsplit(url)[:2] == home or url.startswith(("data:", "blob:")):
            route.continue_()
        else:
            tab.strangers.append(url)
            route.abort()

    def heard(message: Any) -> None:
        if message.type == "error":
            tab.errors.append(f"{message.text} ({message.location.get('url', '')})")

    held.route("**/*", answer)
    tab.page.on("console", heard)
    tab.page.on("pageerror", lambda error: tab.errors.append(str(error)))
    tab.page.on("requestfailed", lambda asked: tab.errors.append(f"{asked.url}: {asked.failure}"))
    try:
        tab.page.goto(address)
        yield tab
    finally:
        held.close()
