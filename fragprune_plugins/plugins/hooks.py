"""Asks plugins, and gives our own answers if no plugin answers.

Every command, the session of a host and the functions of the package ask here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, overload

import torch
from torch import Tensor

from fragprune_plugins.engines import ENGINES, Engine
from fragprune_plugins.errors import EngineError, InputError
from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.schedule import Schedule, Settings
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.plugins import hookspecs
from fragprune_plugins.plugins.loading import Plugins, Wrong, installed
from fragprune_plugins.types import RasterInputs, RasterOutputs, View

if TYPE_CHECKING:
    from fragprune_plugins.hosts.findings import Match
    from fragprune_plugins.hosts.source import HostRepo


def engine_for(
    name: str, device: torch.device | str = "cpu", plugins: Plugins | None = None
) -> Engine:
    """The engine with a name, for tensors on a device: a plugin's or our own. Created once.

    Args:
        name: "auto", "reference", "cpu", "cuda", or a name that a plugin answers.

    Raises:
        EngineError: the name is unknown, or the engine cannot run here.
        PluginError: a plugin raised, or its answer is not an engine.
    """
    device, plugins = torch.device(device), plugins or installed()
    engine = plugins.engines.get((name, device))
    if engine is None:
        hook = hookspecs.fragprune_create_engine
        engine = plugins.ask(hook, _no_engine, name=name, device=device)
        if engine is None:
            raise _unknown_engine(name, plugins.answering(hook))
        plugins.engines[name, device] = engine
    return engine


def schedule_for(settings: Settings, plugins: Plugins | None = None) -> Schedule:
    """The schedule of stage 2: a plugin's, or the paper's.

    Raises:
        PluginError: a plugin raised, or its answer is not a schedule.
    """
    hook = hookspecs.fragprune_create_schedule
    answer = (plugins or installed()).ask(hook, _no_schedule, settings=settings)
    return Schedule(settings) if answer is None else answer


def thresholds_for(
    inputs: RasterInputs, given: Tensor | ThresholdStore | None, plugins: Plugins | None = None
) -> Tensor | None:
    """The thresholds (N,) to draw with, in falloff; None for no truncation.

    Args:
        given: a store, for which plugins are asked unless it is neutral; or thresholds to use as
            they are.
        plugins: the plugins to ask; None for those of the process.

    Raises:
        PluginError: a plugin raised, or its answer is not N thresholds in (0, 1).
    """
    if not isinstance(given, ThresholdStore):
        return given
    if given.neutral:
        return None

    def wrong(answer: Any) -> Wrong | None:
        return _no_thresholds(answer, len(given), inputs.splats.device)

    hook = hookspecs.fragprune_truncate
    answer = (plugins or installed()).ask(hook, wrong, inputs=inputs, store=given)
    return given.values if answer is None else answer


def select_adapter(
    repo: HostRepo, matches: Sequence[Match], plugins: Plugins | None = None
) -> str | None:
    """The name of the adapter that a plugin prefers if several fit; None if no plugin answers.

    Raises:
        PluginError: a plugin raised, or named an adapter that does not fit.
    """
    names = [match.adapter for match in matches]

    def wrong(answer: Any) -> Wrong | None:
        return None if answer in names else (repr(answer), f"one of {', '.join(names)}")

    hook = hookspecs.fragprune_select_adapter
    name: str | None = (plugins or installed()).ask(hook, wrong, repo=repo, matches=matches)
    return name


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


def _unknown_engine(name: str, asked: Sequence[str]) -> EngineError:
    return EngineError(
        "engine",
        repr(name),
        f"one of auto, {', '.join(ENGINES)}, or the name of a plugin's engine "
        f"(plugins asked: {', '.join(asked)})",
        "Choose one; fragprune doctor lists plugins that failed to load.",
    )


def _no_engine(answer: Any) -> Wrong | None:
    fits = callable(getattr(answer, "rasterize", None)) and isinstance(
        getattr(answer, "name", None), str
    )
    return None if fits else (repr(answer), "an engine: a name, and rasterize(inputs, thresholds)")


def _no_schedule(answer: Any) -> Wrong | None:
    expected = "a schedule: a Schedule, or a subclass of it"
    return None if isinstance(answer, Schedule) else (repr(answer), expected)


def _no_thresholds(answer: Any, count: int, device: torch.device) -> Wrong | None:
    """Say what is wrong with a plugin's thresholds. On a GPU this waits for the values."""
    expected = f"({count},) floating-point thresholds in (0, 1) on {device}"
    if not isinstance(answer, Tensor):
        return repr(answer), expected
    found = f"{answer.dtype} {tuple(answer.shape)} on {answer.device}"
    if answer.shape != (count,) or answer.device != device or not answer.is_floating_point():
        return found, expected
    outside = int((~((answer > 0) & (answer < 1))).sum())
    return (f"{outside} thresholds outside (0, 1)", expected) if outside else None
