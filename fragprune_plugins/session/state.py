"""What a session knows of a model, and what it tells."""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable
from dataclasses import dataclass, field
from inspect import signature
from typing import Any

from torch import Tensor

from fragprune_plugins.pressure import StepViews
from fragprune_plugins.schedule import StepPlan
from fragprune_plugins.thresholds import ThresholdStore

Picture = tuple[int, int]
"""A view, and which of its cameras: some hosts draw several in one call."""


@dataclass(frozen=True)
class PopulationChange:
    """Rows of a model changed; the store followed."""

    operation: str
    before: int
    after: int


@dataclass(frozen=True)
class StepStats:
    """One training step that learned.

    Attributes:
        step: of the learning, from 1.
        fragments_per_pixel: drawn, mean over this step's views.
        pressure: lambda used.
        threshold_median: over all Gaussians, in falloff.
        loss: the host's own, without the pressure, summed over this step's views.
    """

    step: int
    fragments_per_pixel: float
    pressure: float
    threshold_median: float
    loss: float = math.nan


@dataclass(frozen=True)
class Summary:
    """What a session gained, over the training views it drew.

    Attributes:
        adapter: its name.
        engine: that drew.
        steps: learned.
        gaussians: in the trained model.
        fragments_before: per pixel, untruncated with the opacities at each view's first visit.
        fragments_after: per pixel, as drawn at each view's last visit.
        target_reached: within 5% of the target speed-up; None without one.
        settings: of the fine-tuning.
    """

    adapter: str
    engine: str
    steps: int
    gaussians: int
    fragments_before: float | None
    fragments_after: float | None
    target_reached: bool | None
    settings: dict[str, Any]


@dataclass
class ModelState:
    """A model's store and everything counted for it."""

    store: ThresholdStore
    steps: int = 0
    plan: StepPlan | None = None
    begun: bool = False  # a step whose loss has not gone backward yet
    pending_parents: Tensor | None = None
    prepared: bool = False
    base_rates: dict[str, float] = field(default_factory=dict)
    baseline: dict[Picture, float] = field(default_factory=dict)  # untruncated fragments/px
    drawn: dict[Picture, float] = field(default_factory=dict)  # fragments/px, last visit
    views: dict[int, Callable[[], Any]] = field(default_factory=dict)  # view -> its last render
    step_views: StepViews = field(default_factory=StepViews)
    held: bool = False  # thresholds met their target and stay
    loaded: weakref.ReferenceType[Any] | None = None  # the means a sidecar's thresholds came with
    stats: StepStats | None = None
    hooked: weakref.WeakSet[Any] = field(default_factory=weakref.WeakSet)
    hooks: list[Any] = field(default_factory=list)
    stepped: int = -1


def named(function: Any, args: Any, kwargs: Any) -> dict[str, Any]:
    """The arguments of a call by name, those left out included; "self" is what it was called on."""
    bound = signature(function).bind(*args, **kwargs)
    bound.apply_defaults()
    return {"self": getattr(function, "__self__", None), **bound.arguments}


def mean(figures: dict[Picture, float]) -> float | None:
    """Of the figures, or None."""
    return sum(figures.values()) / len(figures) if figures else None
