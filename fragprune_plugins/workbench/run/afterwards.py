"""A host that no adapter fits: it trains as it is, and its plain PLY is fine-tuned afterwards."""

from __future__ import annotations

import contextlib
import time
from dataclasses import replace
from pathlib import Path

import click

from fragprune_plugins.errors import DatasetError, UsageError, log
from fragprune_plugins.files.atomic import locked
from fragprune_plugins.hosts.photographs import Photographs
from fragprune_plugins.learning.schedule import QUICK_ITERATIONS, Settings
from fragprune_plugins.workbench.commands import command, options
from fragprune_plugins.workbench.finetune.work import finetune
from fragprune_plugins.workbench.ranks import launched
from fragprune_plugins.workbench.run.unserved import BY_HAND, Unserved
from fragprune_plugins.workbench.scenes import dataset, output, training


def train_then_finetune(
    host: Unserved,
    stage: str,
    settings: Settings,
    engine: options.EngineOptions,
    *,
    again: bool,
    json: bool,
) -> command.Report:
    """Train by the command alone, unless it has (stage "finetune"), then fine-tune its PLY."""
    if launched().several:
        expected = "one, for a codebase that no adapter fits"
        raise UsageError("run", "several processes", expected, BY_HAND)
    settings = _settings_of(host.unlike, settings)
    log.info("no adapter fits (%s), but its PLY is plain 3DGS", host.why)
    photographs, since = host.photographs, 0.0
    if photographs is not None:  # better now than after a training
        dataset.read_scene(photographs.folder, photographs.images)
    if stage == "auto":
        since = time.time() - 1  # file systems round
        if host.output is not None:
            lock = locked(host.output.resolve(), wait=0, what="run")
            click.get_current_context().with_resource(lock)
        log.info("it trains as it is, by itself")
        host.train(quietly=json)
    elif host.output is None:
        remedy = "Add -m FOLDER, also if the training knows no -m: it is not started again."
        raise UsageError("command", "no -m", "the output folder of the training", remedy)
    model = host.saved(since)
    if not host.unlike and (name := training.exposed(model)):
        settings = _settings_of(f"it learned an exposure for {name}", settings)
    out = model.with_name("pruned.ply" if settings.goal.presses else "control.ply")
    log.info("%s learns by vanilla 3DGS's drawing and loss, as in fragprune finetune", model)
    photographs, scene = _scene_of(model, photographs, settings)
    report = finetune(
        model=model,
        out=out,
        itself=settings.itself,
        scene=scene,
        settings=settings,
        seed=settings.seed,
        again=again,
        engine=engine,
        command="run",
        photographs=photographs,
    )
    assert report is not None
    host_data = {"stage": stage, "model_before": str(model), "model_after": str(out)}
    return replace(report, data=report.data | host_data)


def _scene_of(
    model: Path, photographs: Photographs | None, settings: Settings
) -> tuple[Photographs | None, options.SceneOptions]:
    """The photographs of a model's training, by what it wrote or else these, and its cameras."""
    with contextlib.suppress(DatasetError):  # what it wrote as its arguments may be anything
        photographs = output.trained_on(model) or photographs
    if photographs is None:
        return None, options.SceneOptions()
    data = None if settings.itself and output.cameras_of(model) else photographs.folder
    if not settings.itself:
        log.info("from the photographs in %s", data)
    return photographs, options.SceneOptions(data, white_background=photographs.white_background)


def _settings_of(unlike: str, settings: Settings) -> Settings:
    """Those of a model that learns from its own pictures, where photographs show something else."""
    if not unlike:
        return settings
    if not settings.goal.presses:
        expected = "something to learn: its own pictures are the target of this model already"
        raise UsageError("--control", unlike, expected, "Leave it out.")
    log.info("it learns from its own pictures, not from photographs: %s", unlike)
    iterations = min(settings.iterations, QUICK_ITERATIONS)
    return replace(settings, itself=True, iterations=iterations)
