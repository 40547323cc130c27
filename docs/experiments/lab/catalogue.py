"""What experiments compare: data alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from fragprune_plugins.learning.goals import Control, Portable, Pressure
from fragprune_plugins.learning.pressure import LEAST_PRESSURE
from fragprune_plugins.learning.schedule import Settings
from lab.rules import Rule, Start, alpha_cutoff, falloff_threshold, shrunk, without_faint
from lab.scores import SCORES

_FALLOFFS = (0.03, 0.07, 0.12, 0.2)
_ALPHA_LEVELS = (4, 8, 12, 16)
_PRESSURES = tuple(factor * LEAST_PRESSURE for factor in (0.5, 1, 2, 4))
_AREA_PRESSURES = tuple(factor * LEAST_PRESSURE for factor in (2, 4))
_KEPT = 0.6


@dataclass(frozen=True)
class Pruning:
    """Whole Gaussians that go before a training.

    Attributes:
        score: its name in ``scores.SCORES``; taken on the training views.
        keep: share of the Gaussians that stays, those of the highest score.
    """

    score: str
    keep: float


@dataclass(frozen=True)
class Arm:
    """One training of an experiment.

    Attributes:
        series: arms of one series are joined in the plot.
        variant: what sets the arm apart in its series; empty where the series has one arm.
        settings: of the training; every seed replaces theirs.
        rule: gives the thresholds; None where they are learned, or where nothing is truncated.
        warmup: iterations before anything is truncated; None for ``Settings.warmup``.
        every: iterations after which learning changes to holding thresholds, and back; None where
            they learn all the time.
        pruning: comes before the training; None where all Gaussians stay.
        start: changes the model before it trains.
    """

    series: str
    variant: str
    settings: Settings
    rule: Rule | None = None
    warmup: int | None = None
    every: int | None = None
    pruning: Pruning | None = None
    start: Start | None = None

    @property
    def label(self) -> str:
        """The arm's name in tables."""
        return f"{self.series} {self.variant}".strip()

    @property
    def is_control(self) -> bool:
        """Whether the arm trains all Gaussians as they came, without truncation."""
        return self.settings.goal == Control() and self.pruning is None and self.start is None


@dataclass(frozen=True)
class Experiment:
    """A comparison.

    Attributes:
        name: of the experiment, and of its files.
        asks: what it asks, one sentence.
        arms: what is compared.
        over: what the plot shows quality over: fragments or area, and frame time; or iterations.
    """

    name: str
    asks: str
    arms: tuple[Arm, ...]
    over: Literal["fragments", "area", "iterations"] = "fragments"

    def control_of(self, arm: Arm) -> Arm | None:
        """The control of equal length that moves the same parameters; None for a control."""
        if arm.is_control:
            return None
        wanted = _control(arm.settings)
        return next((c for c in self.arms if c.is_control and c.settings == wanted), None)


def _control(settings: Settings) -> Settings:
    return replace(settings, goal=Control())


def rules(settings: Settings) -> Experiment:
    """Learned thresholds against one threshold for all, everything trained equally long."""
    return Experiment(
        "rules",
        "Are learned thresholds better than one falloff threshold, or one alpha cut-off, for all "
        "Gaussians, if everything else trains equally long?",
        (
            Arm("control", "", _control(settings)),
            Arm("learned", "default", settings),
            *(
                Arm("learned", f"λ={pressure:g}", replace(settings, goal=Pressure(pressure)))
                for pressure in _PRESSURES
            ),
            *(Arm("falloff", f"{tau:g}", settings, falloff_threshold(tau)) for tau in _FALLOFFS),
            *(Arm("alpha", f"{cut}/255", settings, alpha_cutoff(cut)) for cut in _ALPHA_LEVELS),
        ),
    )


def overfitting(settings: Settings) -> Experiment:
    """Training views beside held-out ones, over the length of stage 2 and of truncation in it."""
    longest = settings.iterations
    lengths = dict.fromkeys(max(1, round(longest * share)) for share in (0.1, 0.2, 0.4, 1))
    every = [replace(settings, iterations=length) for length in lengths]
    later = dict.fromkeys(round(longest * share) for share in (0.4, 0.6, 0.8))
    return Experiment(
        "overfitting",
        "Does a longer stage 2, or longer truncation in it, improve held-out views, or only those "
        "it learns from?",
        (
            *(Arm("control", f"{each.iterations:,}", _control(each)) for each in every),
            *(Arm("from the first step", f"{e.iterations:,}", e, warmup=0) for e in every),
            *(Arm("opens later", f"after {opens:,}", settings, warmup=opens) for opens in later),
        ),
        over="iterations",
    )


def schedules(settings: Settings) -> Experiment:
    """When thresholds learn: after everything else, together with it, or in turns."""
    later = dict.fromkeys(round(settings.iterations * share) for share in (0.5, 0.8))
    turns = dict.fromkeys(max(1, settings.iterations // number) for number in (10, 40))
    return Experiment(
        "schedules",
        "Should thresholds learn after everything else, together with it, or in turns?",
        (
            Arm("control", "", _control(settings)),
            Arm("together", "", settings, warmup=0),
            *(Arm("after", f"{opens:,}", settings, warmup=opens) for opens in later),
            *(Arm("in turns", f"of {n:,}", settings, warmup=0, every=n) for n in turns),
        ),
    )


def primitives(settings: Settings) -> Experiment:
    """Pruning of whole Gaussians by a score, then equal training without and with truncation."""
    control = _control(settings)
    prunings = [Pruning(score, _KEPT) for score in SCORES]
    prunings += [Pruning("removal-error", keep) for keep in (0.8, 0.4)]
    return Experiment(
        "primitives",
        "What do learned thresholds add to the pruning of whole Gaussians, if everything trains "
        "equally long?",
        (
            Arm("control", "", control),
            Arm("learned", "", settings),
            *(
                Arm(f"{each.score}{more}", f"{each.keep:.0%}", trained, pruning=each)
                for each in prunings
                for more, trained in (("", control), (" + learned", settings))
            ),
        ),
    )


def portable(settings: Settings) -> Experiment:
    """Pressure on the ellipses' area against simple ways to a lighter model without thresholds.

    Raises:
        UsageError: not all parameters move; shapes have to.
    """
    settings, control = replace(settings, goal=Portable()), _control(settings)
    return Experiment(
        "portable",
        "For viewers that know no thresholds: is pressure on the ellipses' area better than to "
        "shrink all Gaussians, or to remove the faint ones, and to train equally long?",
        (
            Arm("control", "", control),
            *(
                Arm("portable", f"λ={pressure:g}", replace(settings, goal=Portable(pressure)))
                for pressure in _AREA_PRESSURES
            ),
            Arm("shrunk", "0.7", control, start=shrunk(0.7)),
            Arm("without faint", "0.15", control, start=without_faint(0.15)),
            Arm("portable", "default", settings),
        ),
        over="area",
    )


EXPERIMENTS: dict[str, Callable[[Settings], Experiment]] = {
    "rules": rules,
    "overfitting": overfitting,
    "schedules": schedules,
    "primitives": primitives,
    "portable": portable,
}
"""By name: makes the experiment from the settings of its longest arms."""

QUESTIONS = {
    "fragments": "Which Gaussians own the fragments, and how many fragments are hardly seen?",
    "stages": "Where does the time of a frame go, from small pictures to 4K?",
}
"""What the other experiments ask, each a module of this package by its name."""
