"""Trains and measures the arms of an experiment; what is done already is not done again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import Interrupted, Terminated
from fragprune_plugins.files.atomic import digest
from fragprune_plugins.files.model import Model
from fragprune_plugins.hosts.photographs import Photographs
from fragprune_plugins.learning.schedule import Schedule, Settings, StepPlan
from fragprune_plugins.plugins.hooks import schedule_for
from fragprune_plugins.workbench.figures.evaluate import (
    Candidate,
    enlarged,
    frame_times,
    measure_all,
)
from fragprune_plugins.workbench.finetune.api import FinetuneResult, finetune
from fragprune_plugins.workbench.finetune.resuming import described
from fragprune_plugins.workbench.models import model as models
from fragprune_plugins.workbench.pruning import best
from fragprune_plugins.workbench.scenes.dataset import Dataset, load_photographs
from lab.catalogue import Arm, Experiment, Pruning
from lab.folder import Folder
from lab.rules import finetune_by
from lab.scene import describe_drawing, describe_photographs
from lab.scores import SCORES

ENLARGED = 4
"""Frames are timed at the photographs' size, and with sides this many times as long."""


@dataclass(frozen=True)
class Outcome:
    """One arm, trained with one seed and measured.

    Attributes:
        arm: what was trained.
        seed: of the order of views.
        before: measurement of the model as it came, without thresholds (``measure``), with
            "frame_ms_enlarged", "frame_ms_enlarged_se", and "psnr_training" and "ssim_training" on
            the views that it learned from; timed in turns with ``after``.
        after: of the model as trained, with its thresholds.
        train_seconds: wall-clock seconds of the training.
    """

    arm: Arm
    seed: int
    before: dict[str, Any]
    after: dict[str, Any]
    train_seconds: float


def run(
    experiment: Experiment,
    model: Path,
    photographs: Photographs,
    out: Path,
    *,
    engine: Engine,
    device: torch.device,
    seeds: Sequence[int],
) -> tuple[Folder, list[Outcome]]:
    """Train and measure what is missing of an experiment, with bars on stderr.

    Writes OUT/NAME.json, the configuration, and a file for each arm and seed into OUT/arms as soon
    as it is measured, so that an interrupted experiment goes on where it was (``Folder``).

    Args:
        experiment: what to compare.
        model: the trained splat; thresholds stored beside it are ignored.
        photographs: to learn from, and to measure on.
        out: the folder.
        engine: draws everything.
        device: of the model and views.
        seeds: one training of every arm for each.

    Returns:
        The folder with the configuration, and the outcomes in the order of arms and seeds.

    Raises:
        RecordError: the folder holds this experiment in another configuration, or a file of it
            cannot be read.
        Interrupted: Ctrl-C; the arms that were finished stay.
        Terminated: SIGTERM; likewise.
    """
    splat = models.load(model, truncation=False, device=device)
    dataset = load_photographs(photographs).to(device)
    asked = _configuration(experiment, model, photographs, dataset, engine, device, seeds)
    folder = Folder(out, experiment.name, asked)
    jobs = [(index, arm, seed) for index, arm in enumerate(experiment.arms) for seed in seeds]
    outcomes = []
    scores = Scores(splat, dataset, engine)
    with tqdm(jobs, desc=experiment.name, unit="training") as bar:
        for index, arm, seed in bar:
            label = f"{arm.label}, seed {seed}"
            bar.set_postfix_str(label)
            work = partial(_outcome, arm, seed, splat, scores, dataset, engine)
            content = folder.part(index, label, work)
            figures = (content[key] for key in ("before", "after", "train_seconds"))
            outcomes.append(Outcome(arm, seed, *figures))
    return folder, outcomes


class Scores:
    """The scores of a model on the training views, each taken once.

    Args:
        splat: N Gaussians, drawn without thresholds.
        dataset: its photographs.
        engine: draws the views.
    """

    def __init__(self, splat: Model, dataset: Dataset, engine: Engine) -> None:
        self._splat, self._engine = splat, engine
        self._views = [shot.view for shot in dataset.train]
        self._known: dict[str, torch.Tensor] = {}

    def prune(self, pruning: Pruning) -> Model:
        """The Gaussians that stay."""
        name = pruning.score
        if name not in self._known:
            views = tqdm(self._views, desc=name, unit="view", leave=None)
            self._known[name] = SCORES[name](self._splat, views, self._engine)
        return self._splat.keep(best(self._known[name], pruning.keep))


def _outcome(
    arm: Arm, seed: int, splat: Model, scores: Scores, dataset: Dataset, engine: Engine
) -> dict[str, Any]:
    """What ``Outcome`` holds of an arm, as plain values."""
    settings = replace(arm.settings, seed=seed)
    begun = splat if arm.pruning is None else scores.prune(arm.pruning)
    train = finetune if arm.rule is None else partial(finetune_by, arm.rule)
    result = train(
        begun if arm.start is None else arm.start.change(begun),
        dataset,
        settings,
        schedule=_schedule(arm, settings),
        engine=engine,
        progress=True,
    )
    if result.interrupted:
        raise (Terminated if result.terminated else Interrupted)(
            arm.label,
            f"stopped after {result.progress.steps} of {settings.iterations} iterations",
            "all of them",
            "Repeat the command: finished arms are kept.",
        )
    before, after = _measure(splat, result, dataset, engine)
    return {"before": before, "after": after, "train_seconds": result.train_seconds}


class InTurns(Schedule):
    """Thresholds learn and are held in turns.

    Args:
        settings: of the training.
        warmup: steps without truncation; None for the settings' own.
        every: steps that learn, and then as many that hold; None where all learn.
    """

    def __init__(self, settings: Settings, warmup: int | None, every: int | None) -> None:
        super().__init__(settings, warmup)
        self.every = every

    def at(self, step: int) -> StepPlan:
        """The plan of a step, counted from 1."""
        plan, over = super().at(step), step - 1 - self.warmup
        held = self.every is not None and over // self.every % 2 == 1
        return replace(plan, learn=plan.learn and not held)


def _schedule(arm: Arm, settings: Settings) -> Schedule:
    """A plugin's, or the default one, unless the arm has its own."""
    if arm.warmup is None:
        return schedule_for(settings)
    return InTurns(settings, arm.warmup, arm.every)


def _measure(
    splat: Model, result: FinetuneResult, dataset: Dataset, engine: Engine
) -> list[dict[str, Any]]:
    """Measurements before and after, timed in turns at both sizes."""
    candidates = [Candidate(splat), Candidate(result.model)]
    views = [enlarged(shot.view, ENLARGED) for shot in dataset.test]
    measured = measure_all(candidates, dataset.test, engine=engine)
    large_frames = frame_times(candidates, views, engine)
    learned_from = measure_all(candidates, dataset.train, engine=engine, repeats=1)
    return [
        usual
        | {f"{key}_enlarged": value for key, value in large.items()}
        | {f"{key}_training": seen[key] for key in ("psnr", "ssim")}
        for usual, large, seen in zip(measured, large_frames, learned_from, strict=True)
    ]


def _configuration(
    experiment: Experiment,
    model: Path,
    photographs: Photographs,
    dataset: Dataset,
    engine: Engine,
    device: torch.device | str,
    seeds: Sequence[int],
) -> dict[str, Any]:
    """Everything that decides about the figures, as plain values."""
    return {
        "asks": experiment.asks,
        "arms": {
            arm.label: {
                "settings": {k: v for k, v in arm.settings.as_dict().items() if k != "seed"},
                "rule": arm.rule and arm.rule.name,
                "schedule": described(_schedule(arm, arm.settings)),
                "start": arm.start and arm.start.name,
            }
            | ({"pruning": asdict(arm.pruning)} if arm.pruning else {})
            for arm in experiment.arms
        },
        "seeds": list(seeds),
        "model": {"name": model.name, "sha256": digest(model)},
        "photographs": describe_photographs(photographs, dataset),
        **describe_drawing(engine, device),
    }
