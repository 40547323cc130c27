"""Records that learning gives to observers: population changes, steps, summaries."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class PopulationChange:
    """Rows of a model changed, and its threshold store changed with them.

    Attributes:
        operation: of the store or of the host, such as "keep" or "training_setup".
    """

    operation: str
    before: int
    after: int


@dataclass(frozen=True)
class StepStats:
    """One training step that learned.

    Attributes:
        step: number of the step, from 1.
        fragments_per_pixel: drawn, mean over this step's views.
        pressure: lambda in this step.
        threshold_median: over all Gaussians, in falloff.
        loss: photometric loss without the pressure, summed over this step's views.
    """

    step: int
    fragments_per_pixel: float
    pressure: float
    threshold_median: float
    loss: float = math.nan


@dataclass(frozen=True)
class Summary:
    """Result of a session on the training views that it drew.

    Attributes:
        steps: number of steps that learned.
        gaussians: in the trained model.
        fragments_before: per pixel, untruncated with the opacities at each view's first visit.
        fragments_after: per pixel, as drawn at each view's last visit.
        target_reached: within 5% of the target speed-up; None without one.
    """

    adapter: str
    engine: str
    steps: int
    gaussians: int
    fragments_before: float | None
    fragments_after: float | None
    target_reached: bool | None
    settings: dict[str, Any]
