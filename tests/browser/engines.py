"""Pages of PlayCanvas and of Spark, unmodified from npm, that draw one model with one camera.

with drawing(browser, "spark", model, view, bridge=True) as page:
    page.picture()      # (H, W, 3) uint8, what the engine has drawn
    page.quads()        # {"pixels": in all quads, "peak": of one pixel}
    page.frames(10)     # milliseconds of each
"""

import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from browser.chromium import Tab, opened, served

from fragprune_plugins.types import View

PACKAGES = {"playcanvas": "2.23.3", "@sparkjsdev/spark": "2.2.0", "three": "0.187.0"}
HERE = Path(__file__).parent
ADAPTERS = HERE.parents[1] / "adapters"
MODULES = {
    "playcanvas": "node_modules/playcanvas/build/playcanvas.mjs",
    "three": "node_modules/three/build/three.module.js",
    "three/addons/": "node_modules/three/examples/jsm/",
    "@sparkjsdev/spark": "node_modules/@sparkjsdev/spark/dist/spark.module.js",
    "fragprune-playcanvas": "adapters/fragprune_playcanvas/fragprune-playcanvas.mjs",
    "fragprune-spark": "adapters/fragprune_spark/fragprune-spark.mjs",
}


class NoEnginesError(Exception):
    """npm or the network is absent."""


@cache
def engines() -> Path:
    """A folder with the engines as npm installs them, kept between runs, or NoEnginesError."""
    names = [f"{name}@{version}" for name, version in PACKAGES.items()]
    key = "-".join(name.replace("/", "-") for name in names)
    folder = Path(tempfile.gettempdir()) / f"fragprune-{key}"
    if not (folder / "done").exists():
        folder.mkdir(exist_ok=True)
        install(folder, "--prefix=.", *names)
        (folder / "done").touch()
    return folder


def install(folder: Path, *what: str) -> None:
    """Let npm install packages into a folder, or raise NoEnginesError."""
    command = ["npm", "install", "--no-audit", "--no-fund", "--fetch-retries=1", *what]
    try:
        subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=120, check=True)
    except (OSError, subprocess.SubprocessError) as error:
        raise NoEnginesError(f"npm install failed: {error}") from error


@dataclass
class Page:
    """One engine, one model, one camera."""

    tab: Tab
    view: View

    def picture(self) -> np.ndarray:
        """What is on the canvas, (H, W, 3) uint8, top row first."""
        pixels = self.tab.array("window.picture()")
        return pixels.reshape(self.view.height, self.view.width, 4)[::-1, :, :3]

    def quads(self) -> dict[str, int]:
        """Pixels in all quads that the engine draws, and the most on one pixel."""
        return self.tab.run("window.quads()")

    def frames(self, count: int) -> list[float]:
        """Milliseconds of frames, each until its last pixel is drawn."""
        return self.tab.run("count => window.frames(count)", count)


@contextmanager
def drawing(browser: Any, engine: str, model: Path, view: View, **options: Any) -> Iterator[Page]:
    """Open a page in which an engine has drawn a model, and expect no error of it.

    The view's principal point is the centre, and both its focal lengths are equal; options are
    those of ``playcanvas.js`` or ``spark.js``.
    """
    engine, *device = engine.split("-")
    fov_y = float(2 * np.degrees(np.arctan(view.tan_fov_y)))
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        (root / "node_modules").symlink_to(engines() / "node_modules")
        (root / "adapters").symlink_to(ADAPTERS)
        (root / f"model{model.suffix}").symlink_to(model.resolve())
        for name in (f"{engine}.js", "page.html"):
            (root / name).symlink_to(HERE / name)
        given = {
            "model": f"model{model.suffix}",
            "width": view.width,
            "height": view.height,
            "camera": {"matrix": placed(view), "fovY": fov_y},
            "webgpu": "webgpu" in device,
            "sorting": "cpu" if "cpu" in device else "auto",
            **options,
        }
        with served(root) as address, opened(browser, address + "page.html") as tab:
            imports = {name: f"./{path}" for name, path in MODULES.items()}
            tab.run("given => window.start(given)", [engine, imports, given])
            yield Page(tab, view)
            assert tab.errors == tab.strangers == []


def placed(view: View) -> list[float]:
    """Camera to world for WebGL (y up, z backward), columns first."""
    to_world = np.linalg.inv(view.viewmatrix.double().numpy().T)
    to_world[:, 1:3] *= -1
    return to_world.T.ravel().tolist()
