"""What a fine-tuning is for: one goal of several, which exclude each other.

As text, for files and flags, a goal is its name and its number: ``fewer=2``, ``control``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import astuple, dataclass
from typing import ClassVar

from fragprune_plugins.errors import UsageError
from fragprune_plugins.learning.pressure import (
    OWN_AREA_PRESSURE,
    OWN_PRESSURE,
    PORTABLE_ELASTICITY,
    ElasticPressure,
    PressureController,
    PressureRule,
)
from fragprune_plugins.learning.targets import Target


@dataclass(frozen=True)
class Goal:
    """What every goal says."""

    name: ClassVar[str]  # in text
    learns: ClassVar[bool] = True  # thresholds open and learn
    presses: ClassVar[bool] = True  # a pressure acts on the loss
    on_area: ClassVar[bool] = False  # on the ellipses' area, from the first step on; shapes move

    def __str__(self) -> str:
        numbers = [f"{number!r}" for number in astuple(self) if number is not None]
        return "=".join([self.name, *numbers])

    def pressure(self, elasticity: float, itself: bool) -> PressureRule:
        """The pressure of a training, a new one.

        Args:
            elasticity: of a pressure that follows the loss.
            itself: the model's own pictures are what it learns from.
        """
        raise NotImplementedError

    def target(self) -> Target | None:
        """What holds thresholds to a ratio; None without one.

        Raises:
            UsageError: a training alone cannot meet the goal.
        """
        return None


@dataclass(frozen=True)
class _Weighted(Goal):
    """A goal with a weight, lambda, which a number may give; ``own`` is that for own pictures."""

    own: ClassVar[float] = OWN_PRESSURE
    weight: float | None = None

    def __post_init__(self) -> None:
        if self.weight is not None and not 0 <= number("pressure", self.weight) < 1:
            expected = "0 <= X < 1 (1e-4 is usual)"
            raise UsageError("pressure", f"{self.weight:g}", expected, "Choose another weight.")

    def pressure(self, elasticity: float, itself: bool) -> PressureRule:
        """The weight; without one, fixed where there is no loss to follow, else elastic."""
        if self.weight is not None:
            return PressureRule(self.weight)
        return PressureRule(self.own) if itself else self.elastic(elasticity)

    def elastic(self, elasticity: float) -> PressureRule:
        """A pressure that follows the loss."""
        return ElasticPressure(elasticity=elasticity)


@dataclass(frozen=True)
class Pressure(_Weighted):
    """Truncate under a pressure on drawn fragments.

    Attributes:
        weight: lambda, weight of drawn fragments per pixel in the loss, from 0 up to 1; None for
            one that follows the loss per fragment, between two ends.
    """

    name: ClassVar[str] = "pressure"


@dataclass(frozen=True)
class Fewer(Goal):
    """Draw so many times fewer fragments.

    Attributes:
        ratio: fragments of the untruncated model as it came in over fragments drawn now, on the
            training views that calibration measures; above 1, up to 20.
    """

    name: ClassVar[str] = "fewer"
    ratio: float

    def __post_init__(self) -> None:
        expect("target speed-up", self.ratio, 1, 20, "1 < X <= 20, fragments before over after")

    def pressure(self, elasticity: float, itself: bool) -> PressureRule:
        """Steered towards the ratio."""
        return PressureController(self.ratio)

    def target(self) -> Target:
        """One shift of all thresholds meets the ratio late in the training."""
        return Target(self.ratio)


@dataclass(frozen=True)
class Portable(_Weighted):
    """For viewers that ignore thresholds: learn none, and cover less area.

    Attributes:
        weight: lambda, weight of the ellipses' area per pixel (``area.area_per_pixel``) in the
            loss, from 0 up to 1; None for one that follows the loss per pixel of area.
    """

    name: ClassVar[str] = "portable"
    learns: ClassVar[bool] = False
    on_area: ClassVar[bool] = True
    own: ClassVar[float] = OWN_AREA_PRESSURE

    def elastic(self, elasticity: float) -> PressureRule:
        """Of the loss per pixel of area."""
        return ElasticPressure(value=0.0, elasticity=PORTABLE_ELASTICITY, least=0.0, most=1.0)


@dataclass(frozen=True)
class Control(Goal):
    """Train as long without thresholds or pressure, to compare with."""

    name: ClassVar[str] = "control"
    learns: ClassVar[bool] = False
    presses: ClassVar[bool] = False

    def pressure(self, elasticity: float, itself: bool) -> PressureRule:
        """None."""
        return PressureRule(0.0)


GOALS: dict[str, type[Goal]] = {each.name: each for each in (Pressure, Fewer, Portable, Control)}
"""By name: those that one training can meet, a host's too."""


def parse_goal(text: str, goals: Mapping[str, type[Goal]] = GOALS) -> Goal:
    """The goal that ``str`` made a text of; UsageError if it made none."""
    name, _, number = text.partition("=")
    try:
        return goals[name](*([float(number)] if number else []))
    except (KeyError, ValueError, TypeError) as error:
        expected = f"one of {', '.join(goals)}, with =X for its number"
        raise UsageError("goal", repr(text)[:80], expected, "Choose one.") from error


def number(what: str, value: object) -> float:
    """A finite number; raises UsageError for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise UsageError(what, repr(value)[:80], "a finite number", "Pass a number.")
    return value


def expect(what: str, value: float, above: float, most: float, expected: str) -> None:
    """Raise UsageError unless a number is above one and at most another."""
    if not above < number(what, value) <= most:
        raise UsageError(what, f"{value:g}", expected, "Choose another number.")
