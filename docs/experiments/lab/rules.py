"""Rules that are not learned, to compare learning with.

A ``Rule`` gives thresholds that follow from opacities. A ``Start`` changes the Gaussians themselves
once, before they train.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.goals import Pressure
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.plugins.hookspecs import hookimpl
from fragprune_plugins.plugins.loading import installed
from fragprune_plugins.types import RasterInputs
from fragprune_plugins.workbench.finetune.api import FinetuneResult, finetune
from fragprune_plugins.workbench.scenes.dataset import Dataset


@dataclass(frozen=True)
class Rule:
    """Thresholds as a function of opacities.

    Attributes:
        name: says which function, with its numbers; recorded with results.
        thresholds: gives (N,) falloff in (0, 1] from (N,) activated opacities. At 1 no more than a
            Gaussian's very centre is left.
    """

    name: str
    thresholds: Callable[[Tensor], Tensor]


def finetune_by(
    rule: Rule, model: Model, dataset: Dataset, settings: Settings, **options: Any
) -> FinetuneResult:
    """Train a model whose thresholds follow a rule, instead of learning.

    In the steps that would learn, views are drawn with the rule's thresholds. They get no gradient,
    and nothing presses on fragments.
    """
    plugins, name = installed(), f"rule {rule.name}"
    plugins.register(_Ruled(rule), name)
    try:
        result = finetune(model, dataset, replace(settings, goal=Pressure(0.0)), **options)
    finally:
        plugins.remove(name)
    if (store := result.model.thresholds) is not None:
        _follow(rule, store, torch.sigmoid(result.model.opacity[:, 0]))
    return result


@dataclass(frozen=True)
class _Ruled:
    """A plugin that puts the rule's thresholds into the store, and draws with them."""

    rule: Rule

    @hookimpl
    def fragprune_truncate(self, inputs: RasterInputs, store: ThresholdStore) -> Tensor:
        _follow(self.rule, store, inputs.splats.opacities.detach())
        return store.values.detach()


def _follow(rule: Rule, store: ThresholdStore, opacities: Tensor) -> None:
    store.place(torch.logit(rule.thresholds(opacities)))


def falloff_threshold(tau: float) -> Rule:
    """One threshold for all Gaussians: each is cut at the same number of standard deviations.

    Args:
        tau: falloff in (0, 1).
    """
    return Rule(
        f"falloff_threshold({tau:g})", lambda opacities: opacities.new_full(opacities.shape, tau)
    )


def alpha_cutoff(levels: float) -> Rule:
    """One limit of alpha for all Gaussians: their thresholds are the limit over their opacities.

    Args:
        levels: the limit in steps of 8 bits, above 0; 1 is the hosts' own limit.
    """
    limit = levels / 255
    return Rule(f"alpha_cutoff({levels:g})", lambda opacities: (limit / opacities).clamp_max(1.0))


@dataclass(frozen=True)
class Start:
    """A change to a model before it trains.

    Attributes:
        name: says which change, with its numbers; recorded with results.
        change: gives the changed model.
    """

    name: str
    change: Callable[[Model], Model]


def shrunk(factor: float) -> Start:
    """All Gaussians shrink alike: scale decay.

    Args:
        factor: on their standard deviations, in (0, 1).
    """
    return Start(
        f"shrunk({factor:g})",
        lambda model: replace(model, scaling=model.scaling + math.log(factor)),
    )


def without_faint(opacity: float) -> Start:
    """Without the Gaussians whose opacity lies below a limit in (0, 1)."""
    return Start(
        f"without_faint({opacity:g})",
        lambda model: model.keep(model.opacity[:, 0].sigmoid() >= opacity),
    )
