"""The strongest truncation that loses no more than so many decibels against the control.

The control trains as long, moves the same and truncates nothing. Held-out views say what is lost:
training views do not, and neither do training views that are kept aside, because the model has
learned them before it came here. One number is chosen on them, the pressure.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from fragprune_plugins.engines import Engine
from fragprune_plugins.learning.goals import Control, Pressure
from fragprune_plugins.learning.interruption import Terminate
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.learning.targets import FEWEST
from fragprune_plugins.workbench.figures.clock import standard_error
from fragprune_plugins.workbench.figures.evaluate import Candidate, psnrs
from fragprune_plugins.workbench.finetune.loop import FinetuneResult
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


@dataclass(eq=False)
class Bounded:
    """What the search found so far.

    Attributes:
        bound: on the loss, dB.
        result: the training of ``trial``; the last one before any was measured.
        trials: figures of all that were measured, in order.
    """

    bound: float
    control: FinetuneResult
    result: FinetuneResult
    trials: list[Trial] = field(default_factory=list)

    @property
    def trial(self) -> Trial | None:
        """That which draws least within the bound; where none is within, that which loses least."""

        def rank(trial: Trial) -> tuple[bool, float]:
            kept = trial.loss <= self.bound
            return not kept, trial.fragments_per_pixel if kept else trial.loss

        return min(self.trials, key=rank, default=None)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``--json``: bound, met, the chosen trial's figures, all trials."""
        chosen = self.trial
        return {
            "bound": self.bound,
            "met": chosen is not None and chosen.loss <= self.bound,
            **({} if chosen is None else asdict(chosen)),
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
    to try next. ``train`` makes one fine-tuning of the model.
    """
    assert isinstance(settings.goal, AtMost)
    say("Training the control, without pruning.")
    last = control = train(replace(settings, goal=Control()))
    found = Bounded(settings.goal.decibels, control, control)
    pressure: float | None = None
    try:
        reference = [] if control.interrupted else _held_out(control, held_out, engine)[0]
        while not last.interrupted and len(found.trials) < TRAININGS:
            at = "the default pressure" if pressure is None else f"pressure {pressure:.2g}"
            say(f"Training {len(found.trials) + 1} of at most {TRAININGS}, at {at}.")
            last = train(replace(settings, goal=Pressure(pressure)))
            if not found.trials:
                found.result = last
            if last.interrupted:
                break
            figures, fragments = _held_out(last, held_out, engine)
            losses = [was - now for was, now in zip(reference, figures, strict=True)]
            loss, error = statistics.fmean(losses), standard_error(losses)
            trial = Trial(last.progress.pressure, loss, error, fragments)
            say(f"Loss against the control: {loss:.3f} dB at {fragments:.1f} fragments/pixel.")
            found.trials.append(trial)
            if found.trial is trial:
                found.result = last
            few = fragments * FEWEST < (last.progress.fragments_before or 0.0)
            near = loss >= found.bound - TOLERANCE
            if (loss <= found.bound and (few or near)) or pressure == _STRONGEST:
                break
            pressure = min(next_pressure(found.trials, found.bound), _STRONGEST)
        interrupted, terminated = last.interrupted, last.terminated
    except KeyboardInterrupt as error:  # not in a training, which ends by itself
        interrupted, terminated = True, isinstance(error, Terminate)
    found.result = replace(found.result, interrupted=interrupted, terminated=terminated)
    return found


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


def _held_out(
    result: FinetuneResult, shots: Sequence[Shot], engine: Engine
) -> tuple[list[float], float]:
    """PSNR of each view, dB, and fragments per pixel, mean over views."""
    figures, fragments = psnrs(Candidate(result.model), shots, engine)
    return figures, statistics.fmean(fragments)
