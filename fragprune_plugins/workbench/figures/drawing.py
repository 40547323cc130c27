"""Draws one rasterization from Python, with thresholds, by any engine."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, overload

from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import InputError
from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.plugins.hooks import engine_for, thresholds_for
from fragprune_plugins.types import RasterInputs, RasterOutputs, View


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
        InputError: thresholds that do not match the Gaussians, or a model without a view.
        EngineError: there is no such engine here.
        PluginError: a plugin raised, or its answer cannot be used.
    """
    if isinstance(inputs, Model) or isinstance(thresholds, View):
        inputs, thresholds = _of_model(inputs, thresholds)
    if isinstance(thresholds, ThresholdStore):
        stop = thresholds.stop if inputs.stop is None else inputs.stop
        rim = thresholds.rim if inputs.rim == "hard" else inputs.rim
        inputs = replace(inputs, stop=stop, rim=rim)
    thresholds = thresholds_for(inputs, thresholds)
    inputs.check_thresholds(thresholds)  # also for engines that are not ours
    if isinstance(engine, str):
        engine = engine_for(engine, inputs.splats.device)
    return engine.rasterize(inputs, thresholds)


def _of_model(model: Any, view: Any) -> tuple[RasterInputs, ThresholdStore | None]:
    """What a model is drawn with from a view."""
    if not (isinstance(model, Model) and isinstance(view, View)):
        raise InputError(
            "rasterize",
            f"{type(model).__name__} and {type(view).__name__}",
            "RasterInputs and thresholds, or a Model and a View",
            "Pass rasterize(model, view); overview(model) makes a view.",
        )
    return RasterInputs(view, model.splats()), model.thresholds
