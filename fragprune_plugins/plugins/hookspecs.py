"""The hooks: what plugins may answer. Names are checked by pluggy when a plugin registers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pluggy

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from fragprune_plugins.engines import Engine
    from fragprune_plugins.hosts.adapter import HostAdapter
    from fragprune_plugins.hosts.findings import Match
    from fragprune_plugins.hosts.source import HostRepo
    from fragprune_plugins.learning.events import PopulationChange, StepStats, Summary
    from fragprune_plugins.learning.schedule import Schedule, Settings
    from fragprune_plugins.learning.thresholds import ThresholdStore
    from fragprune_plugins.types import RasterInputs

PROJECT = "fragprune"
hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@hookspec
def fragprune_register_adapters(register: Callable[[HostAdapter], None]) -> None:
    """Offer adapters; called once per start.

    :param register: call it with each adapter.
    """


@hookspec(firstresult=True)
def fragprune_select_adapter(repo: HostRepo, matches: Sequence[Match]) -> str | None:
    """Break a tie when several adapters fit a folder.

    :param repo: the checkout.
    :param matches: those that fit, with why.
    """


@hookspec(firstresult=True)
def fragprune_truncate(inputs: RasterInputs, store: ThresholdStore) -> Tensor | None:
    """Give the thresholds (N,) in falloff to apply to one rasterization: learned, fixed, your own.

    Asked wherever a model that has thresholds is drawn. Where no plugin answers, it is the learned
    ones.

    :param inputs: camera and the Gaussians about to be drawn: the model's N, or those of them that
        the host picked; their thresholds are picked alike.
    :param store: the learned thresholds of the model being drawn; the answer has one for each.
    """


@hookspec(firstresult=True)
def fragprune_create_engine(name: str, device: torch.device) -> Engine | None:
    """Supply a rasterizer that honours thresholds.

    Asked once for a name and a device. Where no plugin answers, it is one of ours.

    :param name: what the user asked for, "auto" included.
    :param device: where the tensors live.
    """


@hookspec(firstresult=True)
def fragprune_create_schedule(settings: Settings) -> Schedule | None:
    """Decide when thresholds start, move and stop in stage 2.

    Where no plugin answers, it is the paper's schedule.

    :param settings: what the user asked for.
    """


@hookspec
def fragprune_attached(model: Any, store: ThresholdStore) -> None:
    """Look at a model that has just got its store, new or restored.

    :param model: the host's model object.
    :param store: its thresholds.
    """


@hookspec
def fragprune_population_changed(store: ThresholdStore, change: PopulationChange) -> None:
    """Look at rows that were kept, appended or replaced; the store already agrees.

    :param store: the thresholds after the change.
    :param change: what happened, with counts before and after.
    """


@hookspec
def fragprune_step(stats: StepStats) -> None:
    """Look at a training step that is over; do not touch.

    :param stats: step, fragments per pixel, pressure.
    """


@hookspec
def fragprune_saved(path: Path) -> None:
    """Learn that a sidecar was written.

    :param path: of the sidecar.
    """


@hookspec
def fragprune_finished(summary: Summary) -> None:
    """Learn that the host's script ended, however it ended.

    :param summary: what was gained.
    """
