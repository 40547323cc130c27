"""The goals that only ``finetune`` can meet: they time frames, or take several trainings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from fragprune_plugins.errors import UsageError
from fragprune_plugins.learning import goals
from fragprune_plugins.learning.goals import Goal, Pressure, expect, number
from fragprune_plugins.learning.pressure import PressureController, PressureRule
from fragprune_plugins.learning.targets import Target

TIME_FOLLOWS = 0.4  # d ln(frame time) / d ln(fragments): 0.3 in small pictures, 0.5 in large ones


@dataclass(frozen=True)
class Faster(Goal):
    """Draw frames so many times as fast: the frame time of the untruncated model as it came in over
    that of now, on this machine; above 1, up to 20.
    """

    name: ClassVar[str] = "faster"
    ratio: float

    def __post_init__(self) -> None:
        expect("target time", self.ratio, 1, 20, "1 < X <= 20, frame time before over after")

    def pressure(self, elasticity: float, itself: bool) -> PressureRule:
        """Steered towards the ratio."""
        return PressureController(self.ratio, follows=TIME_FOLLOWS)

    def target(self) -> Target:
        """Refuse: whoever trains has to time frames."""
        found = "a training that cannot time single frames"
        remedy = "Aim for fewer fragments here, or use fragprune finetune on the trained PLY."
        raise UsageError("target time", found, "a target in fragments", remedy)


@dataclass(frozen=True)
class AtMost(Goal):
    """Truncate as strongly as a bound on the loss of quality allows; takes several trainings.

    The bound is in dB of PSNR against the control, 0 to 10.
    """

    name: ClassVar[str] = "at-most"
    decibels: float

    def __post_init__(self) -> None:
        if not 0 <= number("largest loss", self.decibels) <= 10:
            found = f"{self.decibels:g}"
            raise UsageError("largest loss", found, "0 to 10 dB", "Choose another bound.")

    def pressure(self, elasticity: float, itself: bool) -> PressureRule:
        """That of the first training with thresholds."""
        return Pressure().pressure(elasticity, itself)

    def target(self) -> Target:
        """Refuse: the bound is one for several trainings."""
        expected = "several, of which the strongest truncation within the bound is chosen"
        remedy = "Use fragprune finetune on the trained PLY."
        raise UsageError("largest loss", "one training", expected, remedy)


def parse_goal(text: str) -> Goal:
    """The goal of any command that ``str`` made a text of; raises as ``goals.parse_goal``."""
    return goals.parse_goal(text, goals.GOALS | {each.name: each for each in (Faster, AtMost)})
