"""Fragment pressure: the weight lambda of drawn fragments per pixel in the loss.

A fixed lambda transfers between well trained scenes, but not between losses: where a loss is
several times larger, or shared by few fragments, it hardly cuts. The default therefore follows the
loss per fragment, from 1e-4 up. To hit a target, a slow controller corrects lambda in the log
domain; thresholds are a slow plant, so it starts from the known curve, waits before it trusts an
error, and never integrates past its limits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from torch import Tensor

    from fragprune_plugins.learning.thresholds import ThresholdStore

    Figure = float | Tensor

LEAST_PRESSURE = 1e-4
"""Least lambda by default, for models whose loss per fragment is very small (overfitted ones)."""

OWN_PRESSURE = 1.5e-4
"""The default for a model that learns from its own pictures; its loss is next to nothing at first.

Chosen on photographs that were not used: docs/how-to/without-photographs.md has the figures.
"""

ELASTICITY = 0.1
"""Per cent of the loss that one per cent of the fragments is worth by default."""

TARGET_TOLERANCE = 0.05
"""A target counts as reached within this relative distance, in fragments per pixel."""

CALIBRATE_AT = 0.85
"""Share of the learning after which one shift of all thresholds meets the target, and they stay."""

CALIBRATION_VIEWS = 24
"""Number of training views that a calibration measures at most."""

_CURVE_SPEEDUP = 1.62  # fragments before / after that LEAST_PRESSURE gives
_CURVE_SLOPE = 0.22  # d ln(speedup) / d ln(lambda), measured between 1.45x and 2.6x


@dataclass(frozen=True)
class Observation:
    """Figures of one step that learned, for the pressure.

    Attributes:
        progress: share of the learning that was over, 0 to 1.
        fragments: drawn per pixel, mean over the step's views.
        untruncated: the same views' before learning began.
        loss: the photometric loss, without the pressure; NaN when not known.
    """

    progress: float
    fragments: float
    untruncated: float
    loss: float


class Pressure(Protocol):
    """Gives lambda for the next step, and is told the figures of each step."""

    value: float

    def observe(self, step: Observation) -> None:
        """Take the figures of a step that is over."""


@dataclass
class FixedPressure:
    """Keeps lambda the same in all steps.

    Attributes:
        value: lambda.
    """

    value: float

    def observe(self, step: Observation) -> None:
        """Do nothing: the value is fixed."""


@dataclass
class ElasticPressure:
    """A share of the loss per fragment: lambda = max(least, elasticity x loss / fragments).

    Following it descends on ln(loss) + elasticity ln(fragments): the same pressure for a loss of
    any scale, of pictures of any size, over any number of fragments.

    Attributes:
        value: lambda.
        elasticity: per cents of the loss that a per cent of the fragments is worth.
        least: lambda's lower end, and its value until a loss is known.
        memory: steps over which loss and fragments are averaged, about a pass of the views.
    """

    value: float = LEAST_PRESSURE
    elasticity: float = ELASTICITY
    least: float = LEAST_PRESSURE
    memory: int = 100
    _steps: int = 0
    _loss: float = 0.0
    _fragments: float = 0.0

    def observe(self, step: Observation) -> None:
        """Average the step in. A loss that is unknown or not positive is left out."""
        if not 0 < step.loss < math.inf:
            return
        self._steps += 1
        weight = 1 / min(self._steps, self.memory)
        self._loss += weight * (step.loss - self._loss)
        self._fragments += weight * (step.fragments - self._fragments)
        self.value = max(self.least, self.elasticity * self._loss / max(self._fragments, 1.0))


@dataclass
class StepViews:
    """The views that one training step draws; a host that trains in batches draws several.

    Such a host divides each view's loss by their number, so the pressure must be their mean as
    well. Their number is known only at the end of a step, so the number of the step before is used,
    and one in the first step. Figures may be scalars on a device; reading them waits for it.

    Attributes:
        expected: views a step.
    """

    expected: int = 1
    _fragments: list[Figure] = field(default_factory=list)
    _untruncated: list[Figure] = field(default_factory=list)
    _losses: list[Figure | None] = field(default_factory=list)

    def begin(self) -> None:
        """Forget the views of the last step; their number is what the next step expects."""
        self.expected = self.drawn or self.expected
        self._fragments, self._untruncated, self._losses = [], [], []

    def draw(self, fragments: Figure, untruncated: Figure) -> None:
        """Note a view drawn with gradients: its fragments per pixel now and before learning."""
        self._fragments.append(fragments)
        self._untruncated.append(untruncated)
        self._losses.append(None)

    def lose(self, loss: Figure) -> None:
        """Note the loss of the view drawn last."""
        if self._losses:
            self._losses[-1] = loss

    @property
    def drawn(self) -> int:
        """Number of views so far."""
        return len(self._fragments)

    @property
    def fragments(self) -> float:
        """Fragments per pixel, mean over the views so far."""
        return _mean(self._fragments)

    @property
    def untruncated(self) -> float:
        """Fragments per pixel before learning, mean over the views so far."""
        return _mean(self._untruncated)

    @property
    def loss(self) -> float:
        """Sum of the known losses of the views so far; NaN if none is known."""
        known = [float(loss) for loss in self._losses if loss is not None]
        return sum(known) if known else math.nan

    @property
    def finite(self) -> bool:
        """Whether all known losses are finite."""
        return all(math.isfinite(loss) for loss in self._losses if loss is not None)


def _mean(figures: list[Figure]) -> float:
    return sum(map(float, figures)) / len(figures)


class PressureController:
    """Steers lambda towards ``target`` times fewer fragments.

    Args:
        target: fragments before over fragments after, > 1.
        warmup: share of the run before the first correction: thresholds have not settled.
        period: share of the run between corrections.
        gain: share of the error, mapped through the known curve, that one correction removes.
        reach: lambda stays within this factor of its starting value (anti-windup).
    """

    def __init__(
        self,
        target: float,
        *,
        warmup: float = 0.2,
        period: float = 0.04,
        gain: float = 0.35,
        reach: float = 60.0,
    ) -> None:
        self.target = target
        self.warmup, self.period, self.gain = warmup, period, gain
        start = LEAST_PRESSURE * (target / _CURVE_SPEEDUP) ** (1 / _CURVE_SLOPE)
        self._log_range = (math.log(start / reach), math.log(start * reach))
        self.value = start
        self._next = warmup
        self._sum = 0.0
        self._count = 0

    def observe(self, step: Observation) -> None:
        """Average the logarithms of the ratios over a period, then correct lambda once."""
        self._sum += math.log(max(step.fragments / max(step.untruncated, 1e-9), 1e-6))
        self._count += 1
        if step.progress < self._next:
            return
        error = math.log(self.target) + self._sum / self._count  # > 0: not enough truncated yet
        change = max(-math.log(2), min(math.log(2), self.gain * error / _CURVE_SLOPE))
        low, high = self._log_range
        self.value = math.exp(max(low, min(high, math.log(self.value) + change)))
        self._next = step.progress + self.period
        self._sum, self._count = 0.0, 0


def calibrate(
    store: ThresholdStore,
    speedup: Callable[[], float],
    target: float,
    *,
    tolerance: float = 0.01,
    reach: float = 8.0,
    rounds: int = 16,
) -> float:
    """Shift all threshold logits by one number so that ``speedup()`` meets ``target``.

    Speed-up grows with the shift, so bisection finds it. Where the target lies out of reach the
    nearest end is kept. Call it late in the run and let opacities adapt afterwards.

    Args:
        store: the thresholds; changed in place.
        speedup: measures fragments before over after with the store as it stands.
        target: fragments before over after.
        tolerance: relative distance at which to stop.
        reach: largest shift either way, in logits.
        rounds: most measurements.

    Returns:
        The speed-up measured last.
    """
    start = store.logits.detach().clone()
    low, high = -reach, reach
    shift, reached = 0.0, speedup()
    for _ in range(rounds):
        if abs(reached / target - 1) <= tolerance:
            break
        if reached < target:
            low = shift
        else:
            high = shift
        shift = (low + high) / 2
        store.place(start + shift)
        reached = speedup()
    return reached
