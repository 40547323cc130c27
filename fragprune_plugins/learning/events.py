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


@dataclass(frozen=True, kw_only=True)
class Progress:
    """State of a stage 2, on the training views that it drew.

    Attributes:
        steps: that learned: the driver's optimizer took them.
        gaussians: N.
        fragments_before: per pixel, mean over the views that were drawn since thresholds opened,
            over all before: untruncated, as at each one's first visit; None where none was drawn.
        fragments_after: likewise, as drawn at each view's last visit.
        speedup: before over after; where a target was met, as measured when it was met.
        faster: frame times before over after, as measured when a target time was met; else None.
        target_reached: the ratio is within 5 % of the target; None without a target.
        pressure: lambda.
    """

    steps: int = 0
    gaussians: int = 0
    fragments_before: float | None = None
    fragments_after: float | None = None
    speedup: float | None = None
    faster: float | None = None
    target_reached: bool | None = None
    pressure: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Summary(Progress):
    """Result of a session.

    Attributes:
        engine: name of the engine that drew stage 2; "" if none drew.
        settings: settings of the fine-tuning.
    """

    adapter: str
    engine: str = ""
    settings: dict[str, Any]
