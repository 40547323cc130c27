"""The strongest truncation that loses no more than so many decibels against the control.

The control trains as long, moves the same and truncates nothing. Held-out views say what is lost:
training views do not, and neither do training views that are kept aside, because the model has
learned them before it came here. One number is chosen on them, the pressure.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch

from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import UsageError
from fragprune_plugins.learning.goals import Control, Pressure
from fragprune_plugins.learning.interruption import Terminate
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.learning.targets import FEWEST
from fragprune_plugins.workbench.figures.evaluate import Candidate
from fragprune_plugins.workbench.figures.metrics import psnr
from fragprune_plugins.workbench.finetune.result import FinetuneResult
from fragprune_plugins.workbench.goals import AtMost
from fragprune_plugins.workbench.scenes.dataset import Shot

TOLERANCE = 0.02
"""A loss this far below the bound, in dB, is not worth another training."""

TRAININGS = 7
"""With thresholds, at most; the control comes on top."""

_FARTHEST = 4.0  # factor from one pressure to the next
_STRONGEST = 0.5  # of pressures: what it does not remove is not to be removed


@dataclass(frozen=True)
class Trial:
    """One training of the search.

    Attributes:
        pressure: lambda at its end.
        loss: of PSNR against the control, dB, mean over held-out views.
        loss_se: standard error of that mean over the views.
        fragments_per_pixel: mean over held-out views.
    """

    pressure: float
    loss: float
    loss_se: float
    fragments_per_pixel: float


@dataclass(frozen=True, eq=False)
class Bounded:
    """What the search found.

    Attributes:
        bound: on the loss, dB.
        result: the strongest truncation within the bound; the one that loses least where none is.
        trial: its figures; None if the search was interrupted before they were taken.
        trials: all of them, in order.
    """

    bound: float
    result: FinetuneResult
    trial: Trial | None
    control: FinetuneResult
    trials: Sequence[Trial]

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``--json``: bound, met, the chosen trial's figures, all trials."""
        chosen = {} if self.trial is None else asdict(self.trial)
        return {
            "bound": self.bound,
            "met": self.trial is not None and self.trial.loss <= self.bound,
            **chosen,
            "trials": [asdict(trial) for trial in self.trials],
        }


def strongest(
    train: Callable[[Settings], FinetuneResult],
    settings: Settings,
    held_out: Sequence[Shot],
    *,
    engine: Engine,
    say: Callable[[str], None] = lambda _: None,
) -> Bounded:
    """Train the control, then with ever better chosen pressures.

    The loss grows nearly in proportion to the pressure: the two trials next to the bound say where
    to try next.

    Args:
        train: makes one fine-tuning of the model.
        settings: of every training; their goal is ``AtMost``.

    Raises:
        UsageError: the goal is another one.
        DivergedError: NaN or infinity in what trains.
    """
    if not isinstance(settings.goal, AtMost):
        raise UsageError("goal", str(settings.goal), "AtMost(decibels)", "Pass such a goal.")
    search = _Search(settings.goal.decibels, say)
    say("Training the control, without pruning.")
    search.last = search.control = control = train(replace(settings, goal=Control()))
    if control.interrupted:
        return search.ended(control.terminated)
    try:
        reference, _ = _held_out(control, held_out, engine)
        while not search.over():
            search.announce()
            search.last = result = train(replace(settings, goal=Pressure(search.pressure)))
            if result.interrupted:
                return search.ended(result.terminated)
            figures, fragments = _held_out(result, held_out, engine)
            losses = [was - now for was, now in zip(reference, figures, strict=True)]
            search.tried(result, losses, fragments)
    except KeyboardInterrupt as error:  # not in a training, which ends by itself
        return search.ended(isinstance(error, Terminate))
    return search.found()


class _Search:
    """A search under way.

    Attributes:
        bound: dB.
        last: the training that ended last.
        pressure: of the next training; None for the default one.
        trials: all that were measured.
        best: of them, with its result.
    """

    control: FinetuneResult
    last: FinetuneResult

    def __init__(self, bound: float, say: Callable[[str], None]) -> None:
        self.bound, self.say = bound, say
        self.pressure: float | None = None
        self.trials: list[Trial] = []
        self.best: tuple[FinetuneResult, Trial] | None = None
        self._enough = False

    def over(self) -> bool:
        """Whether another training is not worth its time."""
        return self._enough or len(self.trials) == TRAININGS

    def announce(self) -> None:
        """Say which training comes."""
        pressure = self.pressure
        at = "the default pressure" if pressure is None else f"pressure {pressure:.2g}"
        self.say(f"Training {len(self.trials) + 1} of at most {TRAININGS}, at {at}.")

    def tried(self, result: FinetuneResult, losses: Sequence[float], fragments: float) -> None:
        """Take a training into account, and choose the next pressure.

        Args:
            losses: of each held-out view against the control, dB.
            fragments: per pixel, mean over held-out views.
        """
        spread = statistics.stdev(losses) / len(losses) ** 0.5 if len(losses) > 1 else 0.0
        trial = Trial(result.progress.pressure, statistics.fmean(losses), spread, fragments)
        self.trials.append(trial)
        self.say(
            f"Loss against the control: {trial.loss:.3f} dB at {fragments:.1f} fragments/pixel."
        )
        if self.best is None or _better(trial, self.best[1], self.bound):
            self.best = result, trial
        before, kept = result.progress.fragments_before or 0.0, trial.loss <= self.bound
        few, near = fragments * FEWEST < before, trial.loss >= self.bound - TOLERANCE
        self._enough = (kept and (few or near)) or self.pressure == _STRONGEST
        if not self.over():
            self.pressure = min(next_pressure(self.trials, self.bound), _STRONGEST)

    def found(self) -> Bounded:
        """The best of all."""
        assert self.best is not None
        return Bounded(self.bound, *self.best, self.control, self.trials)

    def ended(self, terminated: bool) -> Bounded:
        """The best so far, after a signal; without a measured one the last."""
        kept, trial = self.best or (self.last, None)
        kept = replace(kept, interrupted=True, terminated=terminated)
        return Bounded(self.bound, kept, trial, self.control, self.trials)


def next_pressure(trials: Sequence[Trial], bound: float) -> float:
    """The pressure to try next, so that the loss falls just below the bound."""
    aim = bound - TOLERANCE / 2
    weaker = max((t for t in trials if t.loss <= aim), key=lambda t: t.pressure, default=None)
    stronger = min((t for t in trials if t.loss > aim), key=lambda t: t.pressure, default=None)
    if weaker is not None and stronger is not None:
        one, other = weaker, stronger
    elif len(trials) > 1:
        one, other = sorted(trials, key=lambda t: abs(t.loss - aim))[:2]
    else:
        return trials[0].pressure * (2.0 if weaker else 0.5)
    slope = (other.loss - one.loss) / (other.pressure - one.pressure or 1e-12)
    found = one.pressure + (aim - one.loss) / slope if slope > 0 else 0.0
    if stronger is None:  # all keep the bound
        last = max(trial.pressure for trial in trials)
        return min(found, last * _FARTHEST) if found > 1.1 * last else 2 * last
    if weaker is None:  # none does
        return min(max(found, stronger.pressure / _FARTHEST), stronger.pressure / 1.1)
    low, high = sorted((weaker.pressure, stronger.pressure))
    margin = 0.1 * (high - low)
    return min(max(found, low + margin), high - margin)


def _better(trial: Trial, than: Trial, bound: float) -> bool:
    """Whether a trial keeps the bound and draws less, or neither does and it loses less."""
    if trial.loss <= bound and than.loss <= bound:
        return trial.fragments_per_pixel < than.fragments_per_pixel
    return trial.loss < than.loss


@torch.no_grad()
def _held_out(
    result: FinetuneResult, shots: Sequence[Shot], engine: Engine
) -> tuple[list[float], float]:
    """PSNR of each view, dB, and fragments per pixel, mean over views."""
    candidate, splats = Candidate(result.model), result.model.splats()
    figures, fragments = [], []
    for shot in shots:
        shot = shot.to(splats.device)
        outputs = candidate.draw(engine, shot.view, splats)
        figures.append(psnr(shot.looked_at(outputs.image), shot.image))
        fragments.append(float(outputs.fragments_per_pixel))
    return figures, statistics.fmean(fragments)
