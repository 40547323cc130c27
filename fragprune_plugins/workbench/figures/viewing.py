"""Looking at a model from Python: a camera that shows it, its picture, and one rasterization."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, overload

import torch
from PIL.Image import Image
from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import InputError
from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.plugins.hooks import drawn_by, engine_for, thresholds_for
from fragprune_plugins.types import RasterInputs, RasterOutputs, View, check_tensor
from fragprune_plugins.workbench.figures.pictures import picture
from fragprune_plugins.workbench.models import model as models
from fragprune_plugins.workbench.scenes.generated import bounds, not_too_near
from fragprune_plugins.workbench.scenes.pinhole import look_at


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
        width, height: pixels.
        fov_y: vertical field of view, degrees; less for a splat of 0.15 units or less, of which
            hosts would leave out what is nearer than 0.2.

    Raises:
        InputError: there is no such view.
    """
    centre, radius = bounds(models.of(model))
    above = torch.nn.functional.normalize(torch.as_tensor(up, dtype=torch.float32), dim=0)
    check_tensor("overview up", above, 3)
    # As COLMAP's first camera looks: along z, or along y where z is up.
    ahead = torch.eye(3).to(above)[2 if abs(float(above[2])) < 0.9 else 1]
    ahead = torch.nn.functional.normalize(ahead - above * (ahead * above).sum(), dim=0)
    away = torch.nn.functional.normalize(0.4 * above - ahead, dim=0)
    look_at(away, (0, 0, 0), up, width=width, height=height, fov_y=fov_y)  # refuses what is none
    half = math.atan(math.tan(math.radians(fov_y) / 2) * min(1.0, width / height))
    distance, fov_y = not_too_near(radius / math.sin(half), radius, fov_y)
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


@overload
def rasterize(
    inputs: RasterInputs,
    thresholds: Tensor | ThresholdStore | None = None,
    *,
    engine: str | Engine = "auto",
) -> RasterOutputs: ...


@overload
def rasterize(
    inputs: Model, thresholds: View, /, *, engine: str | Engine = "auto"
) -> RasterOutputs: ...


def rasterize(
    inputs: RasterInputs | Model,
    thresholds: Tensor | ThresholdStore | View | None = None,
    *,
    engine: str | Engine = "auto",
) -> RasterOutputs:
    """Draw splats, each truncated at its own threshold. Differentiable; any engine.

    A fragment of Gaussian i is drawn if and only if q <= min(-2 ln tau_i, 2 ln(255 o_i)), where q
    is its squared Mahalanobis distance. The gradient of tau comes from a logistic surrogate at the
    rim. With a soft rim alpha is times the covered share of the pixel, and gradients are true ones.

    Args:
        inputs: camera and Gaussians; or a model, which has its thresholds.
        thresholds: (N,) falloff in (0, 1), used as they are; a store, for which plugins are asked,
            and whose stop and soft rim hold where the inputs have none; or None for no truncation.
            For a model, the view: ``rasterize(model, view)``.
        engine: a name ("auto", "reference", "cpu", "cuda", a plugin's) or an engine object.

    Raises:
        InputError: thresholds that are no falloffs, or do not match the Gaussians; or a model
            without a view.
        EngineError: there is no such engine here.
        PluginError: a plugin raised, or its answer cannot be used.
    """
    if isinstance(inputs, Model) or isinstance(thresholds, View):
        inputs, thresholds = _of_model(inputs, thresholds)
    if isinstance(thresholds, ThresholdStore):
        stop = thresholds.stop if inputs.stop is None else inputs.stop
        rim = thresholds.rim if inputs.rim == "hard" else inputs.rim
        inputs = replace(inputs, stop=stop, rim=rim)
    own = thresholds if isinstance(thresholds, Tensor) else None
    thresholds = thresholds_for(inputs, thresholds)
    inputs.check_thresholds(thresholds)  # also for engines that are not ours
    if own is not None and not ((own >= 0) & (own <= 1)).all():
        remedy = "Pass exp(-q / 2) of a cutoff q."
        raise InputError("thresholds", "numbers outside [0, 1]", "falloffs", remedy)
    return drawn_by(engine_for(engine, inputs.splats.device), inputs, thresholds)


def _of_model(model: Any, view: Any) -> tuple[RasterInputs, ThresholdStore | None]:
    """What a model is drawn with from a view."""
    if not (isinstance(model, Model) and isinstance(view, View)):
        where, found = "rasterize", f"{type(model).__name__} and {type(view).__name__}"
        remedy = "Pass rasterize(model, view); overview(model) makes a view."
        raise InputError(where, found, "RasterInputs and thresholds, or a Model and a View", remedy)
    return RasterInputs(view, model.splats()), model.thresholds
