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
from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.goals import AtMost, Control, Pressure
from fragprune_plugins.learning.interruption import Terminate
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.learning.targets import FEWEST
from fragprune_plugins.plugins.hooks import engine_for
from fragprune_plugins.workbench.figures.evaluate import Candidate
from fragprune_plugins.workbench.figures.metrics import psnr
from fragprune_plugins.workbench.finetune.api import FinetuneResult, finetune
from fragprune_plugins.workbench.ranks import Ranks
from fragprune_plugins.workbench.scenes.dataset import Dataset, Shot

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
        control: the control's result.
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
    model: Model,
    dataset: Dataset,
    settings: Settings,
    *,
    engine: str | Engine = "auto",
    progress: bool = False,
    say: Callable[[str], None] = lambda _: None,
    ranks: Ranks | None = None,
) -> Bounded:
    """Train the control, then with ever better chosen pressures.

    The loss grows nearly in proportion to the pressure: the two trials next to the bound say where
    to try next.

    Args:
        model: the trained splat; not changed.
        dataset: training views to learn from, held-out views to measure the loss on.
        settings: of every training; their goal is ``AtMost``.
        engine: a name or an engine.
        progress: draw a bar for each training on stderr.
        say: called with a line of text before each training.
        ranks: the processes that learn together; this one alone when None.

    Raises:
        UsageError: the goal is another one.
        DivergedError: NaN or infinity in what trains.
    """
    if not isinstance(settings.goal, AtMost):
        raise UsageError("goal", str(settings.goal), "AtMost(decibels)", "Pass such a goal.")
    bound = settings.goal.decibels
    if isinstance(engine, str):
        engine = engine_for(engine, model.device)

    def train(each: Settings) -> FinetuneResult:
        return finetune(model, dataset, each, engine=engine, progress=progress, ranks=ranks)

    say("Training the control, without truncation.")
    control = train(replace(settings, goal=Control()))
    result, trials = control, list[Trial]()
    best: tuple[FinetuneResult, Trial] | None = None
    pressure: float | None = None

    def ended(terminated: bool) -> Bounded:
        kept, trial = best or (result, None)
        kept = replace(kept, interrupted=True, terminated=terminated)
        return Bounded(bound, kept, trial, control, trials)

    if control.interrupted:
        return ended(control.terminated)
    try:
        reference, _ = _held_out(control, dataset.test, engine)
        while len(trials) < TRAININGS:
            at = "the default pressure" if pressure is None else f"pressure {pressure:.2g}"
            say(f"Training {len(trials) + 1} of at most {TRAININGS}, at {at}.")
            result = train(replace(settings, goal=Pressure(pressure)))
            if result.interrupted:
                return ended(result.terminated)
            figures, fragments = _held_out(result, dataset.test, engine)
            losses = [was - now for was, now in zip(reference, figures, strict=True)]
            spread = statistics.stdev(losses) / len(losses) ** 0.5 if len(losses) > 1 else 0.0
            trial = Trial(result.progress.pressure, statistics.fmean(losses), spread, fragments)
            trials.append(trial)
            say(
                f"Loss against the control: {trial.loss:.3f} dB at {fragments:.1f} fragments/pixel."
            )
            if best is None or _better(trial, best[1], bound):
                best = result, trial
            before = result.progress.fragments_before or 0.0
            enough = fragments * FEWEST < before and trial.loss <= bound
            if enough or bound - TOLERANCE <= trial.loss <= bound or pressure == _STRONGEST:
                break
            pressure = min(next_pressure(trials, bound), _STRONGEST)
    except KeyboardInterrupt as error:  # not in a training, which ends by itself
        return ended(isinstance(error, Terminate))
    assert best is not None
    return Bounded(bound, *best, control, trials)


def next_pressure(trials: Sequence[Trial], bound: float) -> float:
    """The pressure to try next, so that the loss falls just below the bound.

    Args:
        trials: one or more.
        bound: dB.
    """
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
