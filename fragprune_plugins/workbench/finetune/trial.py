"""Whether a model knows its photographs by heart: a short training on half of them tells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from fragprune_plugins.engines import Engine
from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.goals import Control, Fewer, Pressure
from fragprune_plugins.learning.schedule import Schedule, Settings
from fragprune_plugins.learning.stage2 import evenly_spaced
from fragprune_plugins.workbench.figures.evaluate import Candidate, psnrs
from fragprune_plugins.workbench.figures.metrics import mean
from fragprune_plugins.workbench.finetune.loop import Training
from fragprune_plugins.workbench.finetune.processes import Processes
from fragprune_plugins.workbench.goals import AtMost, Faster
from fragprune_plugins.workbench.pruning import Keep
from fragprune_plugins.workbench.ranks import Ranks
from fragprune_plugins.workbench.scenes.dataset import Dataset

DROPOUT, KEEP = 0.2, 0.6
"""What suits a model that knows its photographs by heart: docs/experiments/defaults.md."""

BY_HEART = 0.05
"""dB that a model forgets in a trial if it knows its photographs by heart; others 0.04 at most."""

STEPS = 100
_VIEWS = 24  # to measure on
_FEWEST = 8  # photographs, to tell anything


@dataclass(frozen=True)
class Trial:
    """What to learn with and to begin with; and what ``forgotten`` gave, if a trial was made."""

    settings: Settings
    keep: Keep | None = None
    forgotten: float | None = None


def tried(
    model: Model,
    dataset: Dataset,
    settings: Settings,
    keep: Keep | None = None,
    *,
    engine: Engine,
    say: Callable[[str], None],
) -> Trial:
    """Make a trial where nobody chose a dropout, and choose what suits a model of its kind.

    One that knows its photographs by heart learns with dropout, and without four in ten Gaussians;
    another without those that its photographs can spare. Unless somebody chose which: but with all
    that it has if it was pruned before, or if a target is a ratio to what it began with.

    Args:
        settings, keep: that were asked for.
        say: is told what is tried, and what came of it, in a sentence each.
    """
    chosen = settings.dropout is not None or settings.itself or settings.train != "all"
    asked = Trial(settings, keep)
    if chosen or not settings.goal.presses or isinstance(settings.goal, AtMost):
        return asked
    lost = forgotten(model, dataset, engine=engine, seed=settings.seed, say=say)
    if lost is None:
        return asked
    by_heart = lost >= BY_HEART
    whole = model.falloff is None and not isinstance(settings.goal, Fewer | Faster)
    learns = [f"with dropout {DROPOUT:g}"] * by_heart
    if keep is None and whole:
        keep = KEEP if by_heart else "auto"
        which = "four in ten Gaussians" if by_heart else "Gaussians that its photographs can spare"
        learns.append(f"without {which}")
    told = f"they change the others by {-lost:+.2f} dB: it does" + ("" if by_heart else " not")
    say(f"{told}, so it learns {' and '.join(learns)}" if learns else told)
    dropout = DROPOUT if by_heart else None
    return Trial(replace(settings, dropout=dropout), keep, lost)


def forgotten(
    model: Model,
    dataset: Dataset,
    *,
    engine: Engine,
    seed: int = 0,
    say: Callable[[str], None] = lambda _: None,
) -> float | None:
    """How much worse a model shows photographs after some steps on the others, in dB.

    What a model has learned of the scene, steps on every second photograph improve or leave as it
    is. What it has learned of the single photographs, such as their noise, they overwrite. A model
    that is pruned already keeps its thresholds.

    Returns:
        PSNR before minus PSNR after, the mean over at most 24 views; None for fewer than eight
        photographs.
    """
    if len(dataset.train) < _FEWEST:
        return None
    say(f"trying whether the model knows its photographs by heart: {STEPS} steps on half of them")
    learned, others = dataset.train[::2], evenly_spaced(dataset.train[1::2], _VIEWS)
    goal = Pressure(0.0) if model.falloff is not None else Control()
    settings = Settings(iterations=STEPS, goal=goal, threshold_lr=0.0, stop=None, seed=seed)
    half, alone = replace(dataset, train=learned), Processes(Ranks())
    alone.first = False  # no observer is told of its steps
    training = Training(model, half, settings, Schedule(settings), engine, alone)
    training.learn(progress=False)
    other = training.result_model()
    training.end()
    before, after = (mean(psnrs(Candidate(each), others, engine)[0]) for each in (model, other))
    return before - after
