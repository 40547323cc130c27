"""When thresholds learn, how fast, and under what pressure."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal

from fragprune_plugins.errors import UsageError
from fragprune_plugins.learning.pressure import (
    ELASTICITY,
    OWN_AREA_PRESSURE,
    OWN_PRESSURE,
    PORTABLE_ELASTICITY,
    TIME_FOLLOWS,
    ElasticPressure,
    FixedPressure,
    Pressure,
    PressureController,
    numbers_of,
)
from fragprune_plugins.types import is_stop

Train = Literal["opacity", "appearance", "all"]

FINETUNE_ITERATIONS = 5000
QUICK_ITERATIONS = 1000
ITERATIONS_MAX = 10**9
_DECAY = 0.1  # learning rates fall to this share over the run, exponentially


@dataclass(frozen=True)
class _Recipe:
    """What suits one choice of what moves; docs/results.md has the runs that chose it.

    Attributes:
        steps: thresholds learn in the last so many, of one view each; None for all. Where shapes
            follow, truncating for longer still improves the training views and no longer the
            others.
        elasticity: of the default pressure. Shapes that follow repair deeper cuts.
    """

    steps: int | None
    elasticity: float


_RECIPES: dict[Train, _Recipe] = {
    "opacity": _Recipe(None, ELASTICITY),
    "appearance": _Recipe(None, ELASTICITY),
    "all": _Recipe(2000, 2 * ELASTICITY),
}


@dataclass(frozen=True)
class Settings:
    """Settings of a fine-tuning; recorded in the sidecar.

    Attributes:
        iterations: optimizer steps of stage 2.
        train: what moves beside the thresholds: "opacity" (the paper's), "appearance" (opacity and
            SH) or "all", which truncates in the last 2,000 iterations only.
        pressure: lambda, weight of drawn fragments per pixel in the loss; None for one that
            follows the loss per fragment, between two ends.
        target_speedup: fragments of the untruncated model as it came in over fragments drawn now,
            on the training views that calibration measures, to steer for; overrides pressure.
        target_time: frame time of the untruncated model as it came in over frame time now, on the
            same views at their own size, to steer for; overrides pressure and target_speedup.
        threshold_lr: initial learning rate of threshold logits.
        opacity_lr: initial learning rate of opacity logits in stage 2.
        itself: True where the model's own pictures are the target. The default pressure is
            ``OWN_PRESSURE`` then, and no warm-up comes first, for it would have nothing to learn.
        portable: True for viewers that ignore thresholds: none are learned. The pressure is on the
            area of the Gaussians' ellipses instead (``area.area_per_pixel``), from the first step
            on, and shapes must move.
        truncate: False trains without thresholds or pressure: the control to compare with.
        stop: the share of a pixel's light at which the model is drawn and trained from the first
            step on that counts, see ``RasterInputs``; None keeps what the model has.
        seed: of the order of views in ``finetune``; hosts have their own.
        views_per_step: that ``finetune`` draws in each step, whose loss is their mean; hosts have
            their own.
        nonfinite: what to do with a step whose gradients are NaN or infinite: "stop" with an error,
            or "skip" it.
    """

    iterations: int = FINETUNE_ITERATIONS
    train: Train = "all"
    pressure: float | None = None
    target_speedup: float | None = None
    target_time: float | None = None
    threshold_lr: float = 0.05
    opacity_lr: float = 0.01
    itself: bool = False
    portable: bool = False
    truncate: bool = True
    stop: float | None = None
    seed: int = 0
    views_per_step: int = 1
    nonfinite: Literal["stop", "skip"] = "stop"

    def __post_init__(self) -> None:
        if not 1 <= self.iterations <= ITERATIONS_MAX:
            found, most = str(self.iterations)[:20], f"{ITERATIONS_MAX:,}"
            raise UsageError("iterations", found, f"1 to {most}", "Choose another --iters.")
        if self.views_per_step < 1:
            raise UsageError(
                "views per step", str(self.views_per_step), "1 or more", "Raise --views-per-step."
            )
        if self.pressure is not None and not 0 <= self.pressure < 1:
            raise UsageError(
                "pressure", f"{self.pressure:g}", "0 <= X < 1 (1e-4 is usual)", "Change --pressure."
            )
        if self.target_speedup is not None and not 1 < self.target_speedup <= 20:
            raise UsageError(
                "target speed-up",
                f"{self.target_speedup:g}",
                "1 < X <= 20, fragments before over after",
                "Change --target-speedup.",
            )
        if self.target_time is not None and not 1 < self.target_time <= 20:
            raise UsageError(
                "target time",
                f"{self.target_time:g}",
                "1 < X <= 20, frame time before over after",
                "Change --target-time.",
            )
        if not is_stop(self.stop):
            raise UsageError(
                "stop",
                f"{self.stop:g}",
                "1e-4 to 1, a share of a pixel's light (0.01 is usual)",
                "Change --stop.",
            )
        if self.portable and self.stop is not None:
            raise UsageError(
                "options",
                "--portable with --stop",
                "one of the two: viewers that ignore thresholds know no stop",
                "Drop one of the two.",
            )
        if self.portable and self.train != "all":
            raise UsageError(
                "options",
                f"--portable with --train {self.train}",
                "--train all: only shapes that move can cover less area",
                "Drop one of the two.",
            )
        if self.portable and (self.target_speedup, self.target_time) != (None, None):
            raise UsageError(
                "options",
                "--portable with --target-speedup or --target-time",
                "no target: it is met by shifting thresholds, and there are none",
                "Steer with --pressure.",
            )

    @property
    def opens(self) -> bool:
        """Whether thresholds open and learn."""
        return self.truncate and not self.portable

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for the sidecar and ``--json``."""
        return asdict(self)

    @property
    def target(self) -> float | None:
        """The ratio to meet, before over after: of frame times or of fragments; None for none."""
        return self.target_speedup if self.target_time is None else self.target_time

    def make_pressure(self, elasticity: float | None = None) -> Pressure:
        """The pressure these settings ask for.

        Args:
            elasticity: of the default pressure; by what ``train`` names when None.
        """
        if not self.truncate:
            return FixedPressure(0.0)
        if self.target_time is not None:
            return PressureController(self.target_time, follows=TIME_FOLLOWS)
        if self.target_speedup is not None:
            return PressureController(self.target_speedup)
        if self.pressure is not None:
            return FixedPressure(self.pressure)
        if self.itself:
            return FixedPressure(OWN_AREA_PRESSURE if self.portable else OWN_PRESSURE)
        if self.portable:
            return ElasticPressure(value=0.0, elasticity=PORTABLE_ELASTICITY, least=0.0, most=1.0)
        return ElasticPressure(
            elasticity=_RECIPES[self.train].elasticity if elasticity is None else elasticity
        )

    @property
    def warmup(self) -> int:
        """Steps that train without truncation before thresholds open."""
        learning = _RECIPES[self.train].steps
        if learning is None or self.itself or self.portable:
            return 0
        return max(0, self.iterations - steps_of(learning, self.views_per_step))

    @property
    def rate(self) -> float:
        """Factor of all learning rates in ``finetune``: the square root of the views a step.

        Adam's steps have the size of the rate, whatever the gradient's. Where views disagree, V of
        them one by one move a parameter by about sqrt(V) rates, and V together by one.
        """
        return math.sqrt(self.views_per_step)


def steps_of(views: int, views_per_step: int) -> int:
    """Steps that see about so many views, one or more."""
    return max(1, round(views / views_per_step))


@dataclass(frozen=True)
class StepPlan:
    """Plan of one step.

    Attributes:
        learn: thresholds move, and drawn fragments press on the loss. When False they stay as they
            are and truncate as they are; before the first step that learns they are neutral, and
            nothing is truncated. Other parameters train on at the rates below. If
            ``Settings.truncate`` is False this has no effect.
        threshold_lr: learning rate of their logits.
        opacity_lr: learning rate the opacity group gets, None to leave the host's.
        progress: share of the learning that is over, 0 to 1.
        decay: share of its initial learning rate that every other group gets which trains.
        counted: views drawn in this step count: a first visit gives their fragments "before".
    """

    learn: bool
    threshold_lr: float
    opacity_lr: float | None
    progress: float
    decay: float = 1.0
    counted: bool = True


class Schedule:
    """Stage 2 after training: thresholds learn after a warm-up, learning rates decay tenfold.

    Subclass and return an instance from ``fragprune_create_schedule`` to change it.

    Args:
        settings: of the run.
        warmup: steps without truncation; ``Settings.warmup`` when None, which is none in a run of
            2,000 steps or less.
    """

    def __init__(self, settings: Settings, warmup: int | None = None) -> None:
        self.settings = settings
        self.warmup = settings.warmup if warmup is None else warmup

    def at(self, step: int) -> StepPlan:
        """The plan of a step, counted from 1 by the session."""
        settings = self.settings
        decay = _DECAY ** _share(step - 1, settings.iterations - 1)
        over = _share(step - 1 - self.warmup, settings.iterations - 1 - self.warmup)
        return StepPlan(
            learn=step > self.warmup,
            threshold_lr=settings.threshold_lr * settings.rate * _DECAY**over,
            opacity_lr=settings.opacity_lr * settings.rate * decay,
            progress=over,
            decay=decay,
        )

    def make_pressure(self) -> Pressure:
        """The pressure of the run, a new one."""
        return self.settings.make_pressure()

    def as_dict(self) -> dict[str, Any]:
        """What decides beside the settings, as plain values: its numbers and its pressure's."""
        pressure = self.make_pressure()
        return {
            "kind": type(self).__qualname__,
            **numbers_of(self),
            "pressure": {"kind": type(pressure).__qualname__, **numbers_of(pressure)},
        }


def _share(steps: int, of: int) -> float:
    """Steps over all steps, 0 to 1."""
    return min(1.0, max(0.0, steps / max(1, of)))


class JointSchedule(Schedule):
    """Thresholds learn inside the host's own training, from one iteration on.

    Args:
        settings: ``iterations`` is the host's whole run.
        from_step: first step that learns.
    """

    def __init__(self, settings: Settings, from_step: int) -> None:
        super().__init__(settings)
        self.from_step = from_step

    def at(self, step: int) -> StepPlan:
        """Neutral before ``from_step``; the opacity rate stays the host's."""
        progress = _share(step - self.from_step, self.settings.iterations - self.from_step)
        on = step >= self.from_step
        rate = self.settings.threshold_lr * _DECAY**progress
        return StepPlan(on, rate, None, progress, counted=on)

    def make_pressure(self) -> Pressure:
        """As for opacities, whatever ``train`` names: the host trains, and presses for longer."""
        return self.settings.make_pressure(ELASTICITY)
