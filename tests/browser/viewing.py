"""The viewer in a tab: what it draws and counts from a camera, and what our engine draws."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from browser.chromium import Tab, opened, served

from fragprune_plugins import Model, RasterInputs, View, rasterize
from fragprune_plugins.workbench.scenes.dataset import Shot
from fragprune_plugins.workbench.view.site import Layer, camera, make_site, save_site


@dataclass(frozen=True)
class Frame:
    """One picture of the page, rows from the top: (H, W, 3) RGB in [0, 1].

    ``quads`` and ``fragments``, (H, W), count how often one covered each pixel or was drawn there.
    """

    image: np.ndarray
    quads: np.ndarray
    fragments: np.ndarray


def write_page(folder: Path, models: list[Model], view: View, shots: list[Shot] = ()) -> None:
    """The viewer of one model with both sides, or of two."""
    if len(models) == 1:
        layers = [Layer("truncated", 0, True), Layer("untruncated", 0, False)]
    else:
        layers = [Layer(str(i), i, m.thresholds is not None) for i, m in enumerate(models)]
    cameras = [(shot.name, shot.view) for shot in shots]
    save_site(folder, make_site("test", models, layers, cameras, view, shots))


@contextmanager
def viewing(browser: Any, folder: Path, options: str = "", **context: Any) -> Iterator[Tab]:
    """The page of a folder, with its models loaded."""
    with served(folder) as address, opened(browser, f"{address}?{options}", **context) as tab:
        ready = "() => window.viewer && viewer.layers.length === viewer.scene.layers.length"
        tab.page.wait_for_function(ready, timeout=120_000)
        yield tab


def hold(tab: Tab, view: View) -> None:
    """Sort for a camera, and let nothing else draw."""
    tab.run(f"async () => {{ window.held = {json.dumps(camera(view))}; await viewer.hold(held); }}")


def frame(tab: Tab, view: View, layer: int = 0, *, stop: bool = True) -> Frame:
    """Draw a layer with counts from a camera, after ``hold``."""
    width = view.width
    tab.run(
        f"""() => {{
            viewer.drawing.options.stop = {json.dumps(stop)};
            const layer = {{ ...viewer.layers[{layer}], sides: [0, {width}] }};
            viewer.drawing.draw(held, [layer], {{ counted: true }});
        }}"""
    )
    counts = _read(tab, "viewer.drawing.countsAt(0, 0)", "Float32Array", "FLOAT", width)
    return Frame(pixels(tab, view.background.tolist(), width), counts[..., 0], counts[..., 1])


def pixels(tab: Tab, background: list[float], width: int) -> np.ndarray:
    """What was drawn, over a background, rows from the top: (H, W, 3) RGB in [0, 1]."""
    shown = f"viewer.drawing.show({{ background: {background} }})"
    return _read(tab, shown, "Uint8Array", "UNSIGNED_BYTE", width)[..., :3] / 255


def _read(tab: Tab, after: str, array: str, kind: str, width: int) -> np.ndarray:
    """The framebuffer that an expression leaves bound, rows from the top: (H, W, 4)."""
    found = tab.array(
        f"""(() => {{
            {after};
            const {{ gl, width, height }} = viewer.drawing, found = new {array}(width * height * 4);
            gl.readPixels(0, 0, width, height, gl.RGBA, gl.{kind}, found);
            return found;
        }})()"""
    )
    return found.reshape(-1, width, 4)[::-1]


def engine_frame(model: Model, view: View, *, truncated: bool = True) -> np.ndarray:
    """Our cpu engine's picture, (H, W, 3) RGB in [0, 1]."""
    store, rules = (model.thresholds, model.rules) if truncated else (None, {})
    with torch.no_grad():
        inputs = RasterInputs(view, model.splats(), planes=(), **rules)
        image = rasterize(inputs, store, engine="cpu").image
    return image.clamp(0, 1).permute(1, 2, 0).numpy()


def decibels(one: np.ndarray, other: np.ndarray) -> float:
    """Peak signal-to-noise ratio of two pictures in [0, 1]."""
    return float(-10 * np.log10(np.mean((one.astype(float) - other) ** 2)))
