"""What learning tells those who watch it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any


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
