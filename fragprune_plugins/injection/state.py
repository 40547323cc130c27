"""What a session knows of a model, and what it tells."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from fragprune_plugins.learning.stage2 import Stage2
from fragprune_plugins.learning.thresholds import ThresholdStore


@dataclass
class ModelState:
    """A model's thresholds and everything that is known of its training.

    Attributes:
        store: its thresholds.
        stage: that learns them; None where those of a sidecar are only applied.
        steps: of the host, from the first that was seen.
    """

    store: ThresholdStore
    stage: Stage2 | None = None
    steps: int = 0
    begun: bool = False  # a step whose loss has not gone backward yet
    pending_parents: Tensor | None = None
    prepared: bool = False
    views: dict[int, Callable[[], Any]] = field(default_factory=dict)  # view -> its last render
    loaded: weakref.ReferenceType[Any] | None = None  # the means a sidecar's thresholds came with
    hooked: weakref.WeakSet[Any] = field(default_factory=weakref.WeakSet)
    hooks: list[Any] = field(default_factory=list)
    stepped: int = -1
    lent: list[list[tuple[dict[str, Any], float]]] = field(default_factory=list)  # the host's rates
