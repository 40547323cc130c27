"""What experiments compare: data alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, get_args

from fragprune_plugins.errors import UsageError
from fragprune_plugins.learning.goals import Control, Portable, Pressure
from fragprune_plugins.learning.pressure import LEAST_PRESSURE
from fragprune_plugins.learning.schedule import Settings, Train
from lab.rules import Rule, Start, alpha_cutoff, falloff_threshold, shrunk, without_faint

_FALLOFFS = (0.03, 0.07, 0.12, 0.2)
_ALPHA_LEVELS = (4, 8, 12, 16)
_PRESSURES = tuple(factor * LEAST_PRESSURE for factor in (0.5, 1, 2, 4))
_AREA_PRESSURES = tuple(factor * LEAST_PRESSURE for factor in (2, 4))
_SHRINKS = (0.7,)
_FAINT = (0.15,)


_SCORES = (
    "removal-error",
    "opacity",
    "total-weight",
    "largest-weight",
    "light-gaussian",
    "mini-splatting",
    "falloff-gradient",
)
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


def rules(iterations: int, train: Train | None = None) -> Experiment:
    """Learned thresholds against one threshold for all, everything trained equally long.

    Args:
        iterations: of every arm.
        train: what moves in every arm; all parameters when None.
    """
    settings = Settings(iterations=iterations, train=train or "all")
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


def moves(iterations: int, train: Train | None = None) -> Experiment:
    """What should move beside the thresholds, each choice with its own control.

    Args:
        iterations: of every arm.
        train: must be None, because it is what the arms differ in.

    Raises:
        UsageError: ``train`` was given.
    """
    if train is not None:
        raise UsageError(
            "--train",
            f"{train} for the experiment moves",
            "none, because its arms differ in what moves",
            "Remove --train.",
        )
    every = [Settings(iterations=iterations, train=each) for each in get_args(Train)]
    return Experiment(
        "moves",
        "Which parameters should move beside the thresholds?",
        (
            *(Arm("control", each.train, _control(each)) for each in every),
            *(Arm("learned", each.train, each) for each in every),
        ),
    )


def iterations(longest: int, train: Train | None = None) -> Experiment:
    """How long stage 2 should last: a 25th, a fifth and all of the longest.

    Args:
        longest: iterations of the longest arms.
        train: what moves in every arm; all parameters when None.
    """
    lengths = dict.fromkeys(max(1, round(longest / share)) for share in (25, 5, 1))
    every = [Settings(iterations=length, train=train or "all") for length in lengths]
    return Experiment(
        "iterations",
        "How many iterations does stage 2 need, and what do they cost?",
        (
            *(Arm("control", f"{each.iterations:,}", _control(each)) for each in every),
            *(Arm("learned", f"{each.iterations:,}", each) for each in every),
        ),
    )


def overfitting(longest: int, train: Train | None = None) -> Experiment:
    """Training views beside held-out ones, over the length of stage 2 and of truncation in it.

    Args:
        longest: iterations of the longest arms.
        train: what moves in every arm; all parameters when None.
    """
    settings = Settings(iterations=longest, train=train or "all")
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


def schedules(iterations: int, train: Train | None = None) -> Experiment:
    """When thresholds learn: after everything else, together with it, or in turns.

    Args:
        iterations: of every arm.
        train: what moves in every arm; all parameters when None.
    """
    settings = Settings(iterations=iterations, train=train or "all")
    later = dict.fromkeys(round(iterations * share) for share in (0.5, 0.8))
    turns = dict.fromkeys(max(1, iterations // number) for number in (10, 40))
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


def primitives(iterations: int, train: Train | None = None) -> Experiment:
    """Pruning of whole Gaussians by a score, then equal training without and with truncation.

    Args:
        iterations: of every arm.
        train: what moves in every arm; all parameters when None.
    """
    learned = Settings(iterations=iterations, train=train or "all")
    control = _control(learned)
    prunings = [Pruning(score, _KEPT) for score in _SCORES]
    prunings += [Pruning(_SCORES[0], keep) for keep in (0.8, 0.4)]
    return Experiment(
        "primitives",
        "What do learned thresholds add to the pruning of whole Gaussians, if everything trains "
        "equally long?",
        (
            Arm("control", "", control),
            Arm("learned", "", learned),
            *(
                Arm(f"{each.score}{more}", f"{each.keep:.0%}", settings, pruning=each)
                for each in prunings
                for more, settings in (("", control), (" + learned", learned))
            ),
        ),
    )


def portable(iterations: int, train: Train | None = None) -> Experiment:
    """Pressure on the ellipses' area against simple ways to a lighter model without thresholds.

    Args:
        iterations: of every arm.
        train: must be None or "all": shapes have to move.
    """
    settings = Settings(iterations=iterations, train=train or "all", goal=Portable())
    control = _control(settings)
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
            *(Arm("shrunk", f"{factor:g}", control, start=shrunk(factor)) for factor in _SHRINKS),
            *(Arm("without faint", f"{o:g}", control, start=without_faint(o)) for o in _FAINT),
            Arm("portable", "default", settings),
        ),
        over="area",
    )


EXPERIMENTS: dict[str, Callable[[int, Train | None], Experiment]] = {
    "rules": rules,
    "moves": moves,
    "iterations": iterations,
    "overfitting": overfitting,
    "schedules": schedules,
    "primitives": primitives,
    "portable": portable,
}
"""By name: makes the experiment from the iterations of its longest arms and from what moves."""

QUESTIONS = {
    "fragments": "Which Gaussians own the fragments, and how many fragments are hardly seen?",
    "stages": "Where does the time of a frame go, from small pictures to 4K?",
}
"""What the other experiments ask, each a module of this package by its name."""
