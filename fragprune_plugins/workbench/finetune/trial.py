"""Whether a model knows its photographs by heart: a short training on half of them tells."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from fragprune_plugins.engines import Engine
from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.goals import Control, Pressure
from fragprune_plugins.learning.schedule import Schedule, Settings
from fragprune_plugins.learning.stage2 import evenly
from fragprune_plugins.types import RasterInputs
from fragprune_plugins.workbench.figures.metrics import psnr
from fragprune_plugins.workbench.finetune.loop import Alone, Training
from fragprune_plugins.workbench.finetune.resuming import Keeper
from fragprune_plugins.workbench.scenes.dataset import Dataset, Shot

DROPOUT, KEEP = 0.2, 0.6
"""What suits a model that knows its photographs by heart; docs/results.md has the runs."""

BY_HEART = 0.2
"""dB that a model forgets in a trial if it knows its photographs by heart; others 0.05 at most."""

STEPS = 100
_VIEWS = 24  # to measure on
_FEWEST = 8  # photographs, to tell anything


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
    is. What it has learned of the single photographs, such as their noise, they overwrite.

    Args:
        model: not changed. One that is pruned already keeps its thresholds.
        dataset: its photographs, on the model's device.
        engine: draws.
        seed: of the order of views.
        say: is told in a sentence what is tried, before.

    Returns:
        PSNR before minus PSNR after, the mean over at most 24 views; None for fewer than eight
        photographs.
    """
    if len(dataset.train) < _FEWEST:
        return None
    say(f"trying whether MODEL knows its photographs by heart: {STEPS} steps on half of them")
    learned, others = dataset.train[::2], evenly(dataset.train[1::2], _VIEWS)
    goal = Pressure(0.0) if model.falloff is not None else Control()
    settings = Settings(iterations=STEPS, goal=goal, threshold_lr=0.0, stop=None, seed=seed)
    half = replace(dataset, train=learned)
    training = Training(model, half, settings, Schedule(settings), engine, _Unheard())
    training.learn(Keeper(None, training), progress=False)
    return _psnr(model, others, engine) - _psnr(training.result_model(), others, engine)


class _Unheard(Alone):
    """A process that tells no observer of its steps."""

    first = False


@torch.no_grad()
def _psnr(model: Model, shots: Sequence[Shot], engine: Engine) -> float:
    """Mean over photographs, in dB."""
    splats, found = model.splats(), []
    for shot in shots:
        inputs = RasterInputs(shot.view, splats, planes=(), **model.rules)
        image = shot.looked_at(engine.rasterize(inputs, model.falloff).image).clamp(0, 1)
        found.append(psnr(image, shot.image))
    return statistics.fmean(found)
