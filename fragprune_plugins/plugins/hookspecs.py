"""The hooks: what plugins may answer. Names are checked by pluggy when a plugin registers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pluggy

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from fragprune_plugins.engines import Engine
    from fragprune_plugins.hosts.findings import Match, Plain
    from fragprune_plugins.hosts.source import HostRepo
    from fragprune_plugins.learning.events import PopulationChange, StepStats, Summary
    from fragprune_plugins.learning.schedule import Schedule, Settings
    from fragprune_plugins.learning.thresholds import ThresholdStore
    from fragprune_plugins.types import RasterInputs

PROJECT = "fragprune"
hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@hookspec
def fragprune_select_adapter(repo: HostRepo, matches: Sequence[Match]) -> str | None:
    """Break a tie when several adapters fit a folder.

    :param repo: the checkout.
    :param matches: the adapters that fit, with reasons.
    """


@hookspec
def fragprune_read_models(repo: HostRepo) -> Sequence[Plain] | None:
    """Tell which PLYs a codebase saves, and what speaks against each being plain 3DGS.

    Asked by ``fragprune check`` where no adapter fits: ``fragprune finetune`` prunes plain PLYs.

    :param repo: the checkout. Its own model comes first, then those of codebases in its folders.
    """


@hookspec
def fragprune_truncate(inputs: RasterInputs, store: ThresholdStore) -> Tensor | None:
    """Give the thresholds (N,) in falloff to apply to one rasterization: learned, fixed, your own.

    Asked for every rasterization of a model that has thresholds. If no plugin answers, the learned
    thresholds apply.

    :param inputs: the camera and the Gaussians about to be drawn: all N of the model, or a
        selection by the host. The same selection of thresholds applies.
    :param store: the learned thresholds of the model. The answer has one threshold for each.
    """


@hookspec
def fragprune_create_engine(name: str, device: torch.device) -> Engine | None:
    """Supply a rasterizer that honours thresholds.

    Asked once for each name and device. If no plugin answers, one of our engines is used.

    :param name: the name that the user gave, which may be "auto".
    :param device: the device of the tensors.
    """


@hookspec
def fragprune_create_schedule(settings: Settings) -> Schedule | None:
    """Decide when thresholds start, move and stop in stage 2.

    If no plugin answers, our ``Schedule`` is used.

    :param settings: the user's settings.
    """


@hookspec
def fragprune_attached(model: Any, store: ThresholdStore) -> None:
    """Called after a model received its store, new or restored.

    :param model: the host's model object.
    :param store: its thresholds.
    """


@hookspec
def fragprune_population_changed(store: ThresholdStore, change: PopulationChange) -> None:
    """Called after rows were kept, appended or replaced, and the store followed.

    :param store: the thresholds after the change.
    :param change: the kind of change, with counts before and after.
    """


@hookspec
def fragprune_step(stats: StepStats) -> None:
    """Called after a training step; must not change anything.

    :param stats: step, fragments per pixel, pressure.
    """


@hookspec
def fragprune_saved(path: Path) -> None:
    """Called after a sidecar was written.

    :param path: the sidecar's path.
    """


@hookspec
def fragprune_finished(summary: Summary) -> None:
    """Called after the host's script ended, with success or not.

    :param summary: the figures of the run.
    """
