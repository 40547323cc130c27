"""Asks plugins, and gives our own answers if no plugin answers.

Every command, session and function of the package asks here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from fragprune_plugins.engines import ENGINES, Engine, create_engine
from fragprune_plugins.errors import EngineError, PluginError
from fragprune_plugins.learning.schedule import Schedule, Settings
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.plugins import hookspecs
from fragprune_plugins.plugins.loading import Plugins, Wrong, installed
from fragprune_plugins.types import RasterInputs, RasterOutputs, short

if TYPE_CHECKING:
    from fragprune_plugins.hosts.findings import Match
    from fragprune_plugins.hosts.source import HostRepo


def engine_for(
    name: str | Engine, device: torch.device | str = "cpu", plugins: Plugins | None = None
) -> Engine:
    """The engine with a name, for tensors on a device: a plugin's or our own. Created once.

    Args:
        name: "auto", "reference", "cpu", "cuda", one that a plugin answers; or an engine, as it is.

    Raises:
        EngineError: the name is unknown, or the engine cannot run here.
        PluginError: a plugin raised, or its answer is not an engine.
    """
    if not isinstance(name, str):
        return name
    device, plugins = torch.device(device), plugins or installed()
    engine = plugins.engines.get((name, device))
    if engine is None:
        hook = hookspecs.fragprune_create_engine
        engine = plugins.ask(hook, _no_engine, f"engine {name}", name=name, device=device)
        if engine is None and name in ("auto", *ENGINES):
            engine = create_engine(name, device)
        elif engine is None:
            expected = f"one of auto, {', '.join(ENGINES)}, or the name of a plugin's engine "
            expected += f"(plugins asked: {', '.join(plugins.answering(hook)) or 'none'})"
            remedy = "Choose one; fragprune doctor lists plugins that failed to load."
            raise EngineError("engine", repr(name), expected, remedy)
        plugins.engines[name, device] = engine
    return engine


def drawn_by(engine: Engine, inputs: RasterInputs, thresholds: Tensor | None) -> RasterOutputs:
    """What an engine draws; raises PluginError if it is no picture."""
    outputs = engine.rasterize(inputs, thresholds)
    if not isinstance(outputs, RasterOutputs):
        where = f"engine {engine.name} of {type(engine).__module__}"
        remedy = "Fix or uninstall that plugin, or choose another --engine."
        raise PluginError(where, short(outputs), "RasterOutputs", remedy)
    return outputs


def schedule_for(settings: Settings, plugins: Plugins | None = None) -> Schedule:
    """The schedule of stage 2, a plugin's or ours; PluginError for any other answer."""

    def wrong(answer: Any) -> Wrong | None:
        return None if isinstance(answer, Schedule) else (repr(answer), "a schedule (Schedule)")

    hook = hookspecs.fragprune_create_schedule
    answer = (plugins or installed()).ask(hook, wrong, settings=settings)
    return Schedule(settings) if answer is None else answer


def thresholds_for(
    inputs: RasterInputs, given: Tensor | ThresholdStore | None, plugins: Plugins | None = None
) -> Tensor | None:
    """The thresholds (N,) to draw with, in falloff; None for no truncation.

    Plugins are asked about a store that is not neutral; given thresholds are used as they are.

    Raises:
        PluginError: a plugin raised, or its answer is not N thresholds in (0, 1).
    """
    if not isinstance(given, ThresholdStore):
        return given
    if given.neutral:
        return None
    wrong = partial(_no_thresholds, count=len(given), device=inputs.splats.device)
    hook = hookspecs.fragprune_truncate
    answer = (plugins or installed()).ask(hook, wrong, inputs=inputs, store=given)
    return given.values if answer is None else answer


def select_adapter(
    repo: HostRepo, matches: Sequence[Match], plugins: Plugins | None = None
) -> str | None:
    """The name of the adapter that a plugin prefers if several fit; None if no plugin answers."""
    names = [match.adapter for match in matches]

    def wrong(answer: Any) -> Wrong | None:
        return None if answer in names else (repr(answer), f"one of {', '.join(names)}")

    hook = hookspecs.fragprune_select_adapter
    name: str | None = (plugins or installed()).ask(hook, wrong, repo=repo, matches=matches)
    return name


def _no_engine(answer: Any) -> Wrong | None:
    named = isinstance(getattr(answer, "name", None), str)
    fits = named and callable(getattr(answer, "rasterize", None))
    return None if fits else (repr(answer), "an engine: a name, and rasterize(inputs, thresholds)")


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
