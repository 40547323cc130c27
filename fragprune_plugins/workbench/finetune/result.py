"""What a fine-tuning gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.events import Progress, StepStats
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.types import one_line


@dataclass(frozen=True, eq=False)
class FinetuneResult:
    """Result of a fine-tuning.

    Attributes:
        model: the Gaussians with what they learned; what ``train`` did not name is the very tensor
            that came in. A control and a portable model have no thresholds.
        settings: of the fine-tuning.
        curves: one point per step.
        progress: steps done, fragments before and after on the training views, the target.
        train_seconds: wall-clock seconds of the loop.
        engine: the engine's name.
        interrupted: Ctrl-C or SIGTERM ended it early; the result is what was learned until then.
        terminated: SIGTERM ended it.
        resumed_at: steps that came out of a checkpoint; 0 without one.
    """

    model: Model
    settings: Settings
    curves: Sequence[StepStats]
    progress: Progress
    train_seconds: float
    engine: str
    interrupted: bool
    terminated: bool
    resumed_at: int = 0

    __repr__ = one_line
