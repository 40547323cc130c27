"""Fragment pressure: the weight lambda of drawn fragments per pixel in the loss.

A fixed lambda transfers between well trained scenes, but not between losses: where a loss is
larger, or shared by few fragments, it cuts less. The default therefore follows the loss per
fragment, between two ends. Without the upper one a loss that nothing lowers, such as noise in the
photographs, would drive lambda up. To hit a target, a slow controller corrects lambda in the log
domain; thresholds are a slow plant, so it starts from the known curve, waits before it trusts an
error, and never integrates past its limits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    Figure = float | Tensor

LEAST_PRESSURE = 1e-4  # least by default: overfitted models have next to no loss per fragment
MOST_PRESSURE = 4e-4  # largest by default; docs/experiments/large-losses.md says why

OWN_PRESSURE = 1.5e-4
"""The default for a model that learns from its own pictures; its loss is next to nothing at first.

Chosen on photographs that were not used: docs/how-to/without-photographs.md has the figures.
"""

ELASTICITY = 0.1  # per cent of the loss that one per cent of the fragments is worth by default
PORTABLE_ELASTICITY = 0.3  # likewise of the ellipses' area, without thresholds
OWN_AREA_PRESSURE = 3e-4  # ``OWN_PRESSURE`` on the ellipses' area
_CURVE_SPEEDUP = 1.62  # fragments before / after that LEAST_PRESSURE gives
_CURVE_SLOPE = 0.22  # d ln(speedup) / d ln(lambda), measured between 1.45x and 2.6x


@dataclass(frozen=True)
class Observation:
    """Figures of one step that learned, for the pressure."""

    progress: float  # share of the learning that was over, 0 to 1
    fragments: float  # per pixel, mean over the step's views; or what else the pressure acts on
    ratio: float  # before over after of what a target holds, or of the fragments
    loss: float  # photometric, without the pressure; NaN when not known


@dataclass
class PressureRule:
    """Gives lambda for the next step: ``value``, which only other rules change."""

    value: float

    def observe(self, step: Observation) -> None:
        """Take the figures of a step that is over."""


@dataclass
class ElasticPressure(PressureRule):
    """A share of the loss per fragment, elasticity x loss / fragments, from least to most.

    Following it descends on ln(loss) + elasticity ln(fragments). Between the ends that is the same
    pressure for a loss of any scale, of pictures of any size, over any number of fragments.
    """

    value: float = LEAST_PRESSURE  # lambda
    elasticity: float = ELASTICITY  # per cents of the loss that one of the fragments is worth
    least: float = LEAST_PRESSURE  # lambda's lower end, and its value until a loss is known
    most: float = MOST_PRESSURE
    memory: int = 100  # steps that loss and fragments are averaged over: about a pass of the views
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
        share = self.elasticity * self._loss / max(self._fragments, 1.0)
        self.value = min(max(self.least, share), self.most)


@dataclass
class StepViews:
    """The views that one training step draws; a host that trains in batches draws several.

    Such a host divides each view's loss by their number, and so must the pressure. It is known at
    the end of a step, so that of the step before is used. Figures may be scalars on a device.
    """

    expected: int = 1
    _rows: list[list[Figure]] = field(default_factory=list)

    def begin(self) -> None:
        """Forget the views of the last step, except for their number."""
        self.expected = self.drawn or self.expected
        self._rows = []

    def draw(self, fragments: Figure, untruncated: Figure, pressed: Figure) -> None:
        """Note a view drawn with gradients: its fragments per pixel now and before learning.

        Args:
            pressed: what the pressure acts on.
        """
        self._rows.append([fragments, untruncated, pressed])  # the loss comes later

    def lose(self, loss: Figure) -> None:
        """Note a loss of the view drawn last; several add up."""
        if self._rows:
            self._rows[-1][3:] = [sum(self._rows[-1][3:], loss)]

    def rows(self) -> list[list[float]]:
        """Of each view so far: fragments, untruncated, pressed, loss; NaN for an unknown one."""
        return [[float(each) for each in (*row, math.nan)[:4]] for row in self._rows]

    @property
    def drawn(self) -> int:
        """Number of views so far."""
        return len(self._rows)

    def means(self) -> tuple[float, ...]:
        """Of fragments, untruncated and pressed, over the views so far."""
        return tuple(sum(column) / self.drawn for column in zip(*self.rows(), strict=True))[:3]

    @property
    def loss(self) -> float:
        """Sum of the known losses of the views so far; NaN if none is known."""
        known = [float(row[3]) for row in self._rows if len(row) > 3]
        return sum(known) if known else math.nan


class PressureController(PressureRule):
    """Steers lambda towards a ratio of before to after: of fragments, or of what follows them.

    Args:
        target: before over after, > 1.
        follows: per cents that it falls by if fragments fall by one.
    """

    warmup = 0.2  # share of the run before the first correction: thresholds have not settled
    period = 0.04  # share of the run between corrections
    gain = 0.35  # share of the error, mapped through the known curve, that a correction removes
    reach = 60.0  # lambda stays within this factor of its starting value (anti-windup)

    def __init__(self, target: float, *, follows: float = 1.0) -> None:
        self.target = target
        self._slope = follows * _CURVE_SLOPE
        start = LEAST_PRESSURE * (target ** (1 / follows) / _CURVE_SPEEDUP) ** (1 / _CURVE_SLOPE)
        self._log_range = (math.log(start / self.reach), math.log(start * self.reach))
        self.value = start
        self._next = self.warmup
        self._sum = 0.0
        self._count = 0

    def observe(self, step: Observation) -> None:
        """Average the logarithms of the ratios over a period, then correct lambda once."""
        self._sum -= math.log(min(step.ratio, 1e6))
        self._count += 1
        if step.progress < self._next:
            return
        error = math.log(self.target) + self._sum / self._count  # > 0: not enough truncated yet
        change = max(-math.log(2), min(math.log(2), self.gain * error / self._slope))
        low, high = self._log_range
        self.value = math.exp(max(low, min(high, math.log(self.value) + change)))
        self._next = step.progress + self.period
        self._sum, self._count = 0.0, 0
