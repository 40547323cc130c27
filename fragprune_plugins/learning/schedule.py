"""When thresholds learn, how fast, and under what pressure."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

from fragprune_plugins.errors import UsageError
from fragprune_plugins.learning.goals import Goal, Pressure
from fragprune_plugins.learning.pressure import ELASTICITY, ElasticPressure, PressureRule
from fragprune_plugins.types import Rim, is_stop

Train = Literal["opacity", "appearance", "all"]

FINETUNE_ITERATIONS = 5000
QUICK_ITERATIONS = 1000
ITERATIONS_MAX = 10**9
USUAL_STOP = 0.02  # share of a pixel's light; docs/experiments/defaults.md says why

_DEFAULT_GOAL = Pressure()
_DECAY = 0.1  # learning rates fall to this share over the run, exponentially

# Where all moves; docs/experiments/defaults.md has the runs that chose these.
_LEARNING_STEPS = 2000
"""Thresholds learn in the last so many, of one view each: where shapes follow, truncating for
longer still improves the training views and no longer the others."""
_ELASTICITY_OF_ALL = 2 * ELASTICITY  # shapes that follow repair deeper cuts
_LEAST_AFTER_DROPOUT = 2e-4  # the default pressure's lower end after a warm-up with dropout


@dataclass(frozen=True)
class Settings:
    """Settings of a fine-tuning; recorded with its result.

    Attributes:
        iterations: optimizer steps of stage 2.
        train: what moves beside the thresholds: "opacity" (the paper's), "appearance" (opacity and
            SH) or "all", which truncates in the last 2,000 iterations only.
        goal: what to truncate for, one of ``goals``; a pressure by default.
        threshold_lr: initial learning rate of threshold logits.
        opacity_lr: initial learning rate of opacity logits in stage 2.
        itself: True where the model's own pictures are the target. The default pressure is
            ``OWN_PRESSURE`` then, and no warm-up comes first, for it would have nothing to learn.
        stop: the share of a pixel's light at which the model is drawn and trained from the first
            step on that counts, see ``RasterInputs``. "auto" is ``USUAL_STOP`` where thresholds
            learn from photographs and the model has no stop of its own. None adds none.
        rim: how thresholds cut, "hard" or "soft", see ``RasterInputs``; None keeps what the model
            has.
        dropout: the share of Gaussians that a step leaves out at first, 0 to below 1, see
            ``Stage2.dropped``; it falls to nothing over the run. None is none, unless the driver
            finds out that the model needs some.
        seed: of the order of views in ``finetune``; hosts have their own.
        views_per_step: that ``finetune`` draws in each step, whose loss is their mean; hosts have
            their own.

    Raises:
        UsageError: a value is of another kind, or out of range.
    """

    iterations: int = FINETUNE_ITERATIONS
    train: Train = "all"
    goal: Goal = _DEFAULT_GOAL
    threshold_lr: float = 0.05
    opacity_lr: float = 0.01
    itself: bool = False
    stop: float | Literal["auto"] | None = "auto"
    rim: Rim | None = None
    dropout: float | None = None
    seed: int = 0
    views_per_step: int = 1

    def __post_init__(self) -> None:
        def whole(least: int, most: int) -> Callable[[Any], bool]:
            return lambda value: type(value) is int and least <= value <= most

        def rate(value: Any) -> bool:
            return type(value) in (int, float) and 0 <= value < math.inf

        def stop(value: Any) -> bool:
            return value == "auto" or is_stop(value)

        checks: tuple[tuple[str, Callable[[Any], bool], str], ...] = (
            ("iterations", whole(1, ITERATIONS_MAX), f"1 to {ITERATIONS_MAX:,}, a whole number"),
            ("train", get_args(Train).__contains__, f"one of {', '.join(get_args(Train))}"),
            ("goal", lambda value: isinstance(value, Goal), "a goal, such as Pressure(1e-4)"),
            ("threshold_lr", rate, "a number, 0 or more"),
            ("opacity_lr", rate, "a number, 0 or more"),
            ("itself", lambda value: isinstance(value, bool), "True or False"),
            ("stop", stop, "1e-4 to 1, a share of a pixel's light, 'auto' or none"),
            ("rim", (None, *get_args(Rim)).__contains__, "hard, soft or None"),
            ("dropout", lambda value: value is None or (rate(value) and value < 1), "0 to below 1"),
            ("seed", lambda value: type(value) is int, "a whole number"),
            ("views_per_step", whole(1, ITERATIONS_MAX), "a whole number, 1 or more"),
        )
        for name, fits, expected in checks:
            if not fits(value := getattr(self, name)):
                where = name.replace("_", " ")
                raise UsageError(where, repr(value)[:80], expected, "Correct this setting.")
        if not self.goal.on_area:
            return
        model, remedy = f"a {self.goal.name} model", "Drop one of the two."
        for name in ("stop", "rim"):
            if getattr(self, name) not in (None, "auto"):
                expected = f"one of the two: viewers that ignore thresholds ignore a {name}"
                raise UsageError("options", f"{model} with a {name}", expected, remedy)
        if self.train != "all":
            expected = "all: only shapes that move can cover less area"
            raise UsageError("options", f"{model} with train={self.train!r}", expected, remedy)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for records and ``--json``; the goal as text (``goals.parse_goal``)."""
        return {**asdict(self), "goal": str(self.goal)}

    def make_pressure(self, elasticity: float | None = None) -> PressureRule:
        """The pressure these settings ask for; ``elasticity`` replaces that of ``train``."""
        own = _ELASTICITY_OF_ALL if self.train == "all" else ELASTICITY
        rule = self.goal.pressure(own if elasticity is None else elasticity, self.itself)
        after_dropout = elasticity is None and self.dropout and self.warmup
        if isinstance(rule, ElasticPressure) and after_dropout:
            rule.value = rule.least = _LEAST_AFTER_DROPOUT
        return rule

    def stop_of(self, own: float | None) -> float | None:
        """The stop at which a model is drawn that came with its own, or with None."""
        if self.stop != "auto":
            return own if self.stop is None else self.stop
        return USUAL_STOP if own is None and self.goal.learns and not self.itself else own

    @property
    def warmup(self) -> int:
        """Steps that train without truncation before thresholds open."""
        if self.train != "all" or self.itself or self.goal.on_area:
            return 0
        return max(0, self.iterations - steps_of(_LEARNING_STEPS, self.views_per_step))

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
            ``Goal.presses`` is False this has no effect.
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
        warmup: steps without truncation; ``Settings.warmup`` when None.
    """

    from_step = 1  # the first that learns

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

    def make_pressure(self) -> PressureRule:
        """The pressure of the run, a new one."""
        return self.settings.make_pressure()


def _share(steps: int, of: int) -> float:
    """Steps over all steps, 0 to 1."""
    return min(1.0, max(0.0, steps / max(1, of)))


class JointSchedule(Schedule):
    """Thresholds learn from a step on in the host's own training, of ``iterations`` steps."""

    def __init__(self, settings: Settings, from_step: int) -> None:
        super().__init__(settings)
        self.from_step = from_step

    def at(self, step: int) -> StepPlan:
        """Neutral before ``from_step``; the opacity rate stays the host's."""
        progress = _share(step - self.from_step, self.settings.iterations - self.from_step)
        on = step >= self.from_step
        rate = self.settings.threshold_lr * _DECAY**progress
        return StepPlan(on, rate, None, progress, counted=on)

    def make_pressure(self) -> PressureRule:
        """As for opacities, whatever ``train`` names: the host trains, and presses for longer."""
        return self.settings.make_pressure(ELASTICITY)
