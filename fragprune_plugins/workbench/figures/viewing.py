"""Looking at a model from Python: a camera that shows it, and its picture from a camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from fragprune_plugins.engines import Engine
from fragprune_plugins.files.model import Model
from fragprune_plugins.types import RasterInputs, View
from fragprune_plugins.workbench.figures.drawing import rasterize
from fragprune_plugins.workbench.figures.pictures import picture
from fragprune_plugins.workbench.models import model as models
from fragprune_plugins.workbench.scenes.generated import bounds
from fragprune_plugins.workbench.scenes.pinhole import look_at

if TYPE_CHECKING:
    from PIL.Image import Image


def overview(
    model: Model | models.Trained | str | Path,
    up: Sequence[float] = (0.0, -1.0, 0.0),
    *,
    width: int = 960,
    height: int = 720,
    fov_y: float = 50.0,
) -> View:
    """A camera outside of a splat that shows it, from a little above; black background.

    It looks at the median of the means, from where nine tenths of them fit into the picture. A
    splat does not say where its photographs were taken: of a room this shows the walls from behind,
    and ``load_cameras`` reads the training's own cameras.

    Args:
        model: N Gaussians, the result of a training, or a file.
        up: (3,) what is up in its world; COLMAP's worlds have y down.
        width: pixels.
        height: pixels.
        fov_y: vertical field of view, degrees.

    Raises:
        InputError: there is no such view.
    """
    centre, radius = bounds(models.of(model))
    half = math.atan(math.tan(math.radians(fov_y) / 2) * min(1.0, width / height))
    above = torch.nn.functional.normalize(torch.tensor(up, dtype=torch.float32), dim=0)
    # As COLMAP's first camera looks: along z, or along y where z is up.
    ahead = torch.eye(3)[2 if abs(float(above[2])) < 0.9 else 1]
    ahead = torch.nn.functional.normalize(ahead - above * (ahead @ above), dim=0)
    away = torch.nn.functional.normalize(0.4 * above - ahead, dim=0)
    distance = radius / math.sin(half)
    eye = centre + distance * away
    return look_at(eye, centre, up, width=width, height=height, fov_y=fov_y)


def render_view(
    model: Model | models.Trained | str | Path,
    view: View | None = None,
    *,
    engine: str | Engine = "auto",
) -> Image:
    """A picture of a model, as its thresholds and stop say; ``rasterize`` gives more than that.

    Args:
        model: what ``load`` gave, the result of a training, or a file.
        view: the camera; one that shows the splat from outside, ``overview``, when None.
        engine: a name ("auto", "reference", "cpu", "cuda", a plugin's) or an engine object.

    Returns:
        A Pillow image, RGB of 8 bits: ``.save("view.png")``.

    Raises:
        EngineError: there is no such engine here.
        PluginError: a plugin raised, or its answer cannot be used.
    """
    model = models.of(model)
    view = (overview(model) if view is None else view).to(model.device)
    with torch.no_grad():
        inputs = RasterInputs(view, model.splats(), planes=())
        return picture(rasterize(inputs, model.thresholds, engine=engine).image)
