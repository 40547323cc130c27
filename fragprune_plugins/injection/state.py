"""What a session knows of a model, and what it tells."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass, field
from inspect import signature
from typing import Any

from torch import Tensor

from fragprune_plugins.learning.events import StepStats
from fragprune_plugins.learning.pressure import StepViews
from fragprune_plugins.learning.schedule import StepPlan
from fragprune_plugins.learning.thresholds import ThresholdStore

Picture = tuple[int, int]
"""A view, and which of its cameras: some hosts draw several in one call."""


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
