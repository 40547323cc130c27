"""Runs a host's command, and measures what stage 2 did on the views that the host holds out.

Between the stages it looks whether the model knows its photographs by heart.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import click
import torch
from torch import Tensor

from fragprune_plugins import errors
from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import FragpruneError, NotComparedError, log
from fragprune_plugins.files import sidecar
from fragprune_plugins.files.model import Model
from fragprune_plugins.hosts.photographs import Photographs
from fragprune_plugins.injection import launch, process
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.plugins.loading import installed
from fragprune_plugins.types import RasterInputs, RasterOutputs
from fragprune_plugins.workbench.commands import logs, opening
from fragprune_plugins.workbench.commands.command import JSON, Report
from fragprune_plugins.workbench.commands.options import EngineOptions
from fragprune_plugins.workbench.figures import evaluate, matching, records, wording
from fragprune_plugins.workbench.finetune.relocation import least, relocates
from fragprune_plugins.workbench.finetune.trial import Trial, tried
from fragprune_plugins.workbench.models.model import load
from fragprune_plugins.workbench.pruning import kept, scored
from fragprune_plugins.workbench.run.afterwards import train_then_finetune
from fragprune_plugins.workbench.run.lively import Lively
from fragprune_plugins.workbench.run.unserved import Unserved, unserved
from fragprune_plugins.workbench.scenes import generated, output, training

_OF_SUMMARY = (
    *("adapter", "engine", "device", "stage", "gaussians", "settings"),
    *("train_seconds", "target_reached", "already_finished"),
)
_CONTROL = (  # joint learning has no model of before
    "To see what pruning did, train as long with --stage off and another output folder, and run "
    "fragprune compare."
)
_ALL_SEEN = (
    "The host held no view out, so these figures are of views that it learned from; those of "
    "others are lower. To see those, hold some out from stage 1 on (in 3DGS: --eval)."
)


def run(
    *,
    host_command: tuple[str, ...],
    stage: Any,
    settings: Settings,
    engine: EngineOptions,
    adapter: str | None = None,
    from_iter: int | None = None,
    again: bool = False,
    trust: bool = False,
) -> Report:
    """Do what ``fragprune run`` promises; its options are the arguments."""
    opening.bound_threads(engine.threads)
    logging.basicConfig(level=logging.INFO, format="fragprune: %(message)s", stream=sys.stderr)
    as_json = click.get_current_context().meta[JSON]
    looking = Looking(engine)
    options = launch.RunOptions(
        adapter=adapter,
        stage=stage,
        settings=settings,
        from_iter=from_iter,
        engine=engine.name,
        device=engine.device,
        again=again,
        trust=trust,
        look=looking,
    )
    before, after, code = None, None, 0
    # A host prints to stdout; with --json, stdout gets only our object.
    with contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext():
        warmup = 0 if stage == "joint" else settings.warmup
        plugins = installed()
        plugins.register(looking.lively, "lively")
        try:
            with logs.logging_steps([logs.Bar(settings.iterations, warmup)]):
                summary = _launched(host_command, options)
        finally:
            plugins.remove("lively")
        if isinstance(summary, Unserved):
            return train_then_finetune(summary, stage, settings, engine, again=again, json=as_json)
        _expect_steps(summary, options)
        _expect_thresholds(summary, settings)
        photographs = photographs_of(summary)
        not_compared: FragpruneError | None = summary.not_compared
        if photographs:
            try:
                with process.current_gpu(engine.device), _enough_memory():
                    photographs, (*first, after) = measure_models(photographs, engine)
                    before = first[0] if first else None
            except FragpruneError as error:  # the trained model is saved already
                not_compared = error
    data = figures_of(summary, settings, looking, before, after, not_compared, host_command)
    if (summary.steps or after) and summary.model_after:
        more = {"curves": summary.curves, "photographs": photographs and photographs.as_dict()}
        if after and not summary.steps:  # a run that was interrupted while it measured
            more |= {"iterations": summary.settings["iterations"], "gaussians": after["gaussians"]}
        code = records.leave_or_tell(summary.model_after, "run", data | more)
    return Report(data, _describe(summary, data), code)


def _launched(command: Sequence[str], options: launch.RunOptions) -> launch.RunSummary | Unserved:
    """The command run under its adapter; what there is to run where none fits."""
    try:
        summary = launch.run(list(command), options)
        if _of_other_options(summary, command):
            log.info("it was learned before by a command with other options: learning again")
            summary = launch.run(list(command), replace(options, stage="finetune", again=True))
        return summary
    except errors.UnknownHostError:
        after = options.stage in ("auto", "finetune") and options.from_iter is None
        host = unserved(command) if after and options.adapter is None else None
        if host is None:
            raise
        return host


def _of_other_options(summary: launch.RunSummary, command: Sequence[str]) -> bool:
    """Whether a result that was there before is of a command with other options of the host."""
    if not summary.already_finished or not summary.model_after:
        return False
    record = records.beside(summary.model_after)
    then = record and record.data.get("host_options")
    return then is not None and then != _options(command)


def _expect_steps(summary: launch.RunSummary, options: launch.RunOptions) -> None:
    """Refuse a stage 2 that took no step, and warn of one that ended before its last."""
    wanted = summary.settings.get("iterations", summary.steps)  # a method may count otherwise
    begun = (summary.model_before or summary.steps) and not summary.already_finished
    if not begun or summary.steps >= wanted:
        return
    if options.stage == "joint" or options.from_iter is not None:
        said = "learned in %d of %d iterations: the host made the others in a way that is not known"
        log.warning(said, summary.steps, wanted)
        return
    found = f"stage 2 ended after {summary.steps} of {wanted} iterations"
    expected = "the length that its command says, whatever a file of options says"
    remedy = "Take the length out of that file; or prune the trained PLY: fragprune finetune."
    error = errors.HostFailed(f"{summary.adapter}'s script", found, expected, remedy)
    if not summary.steps:
        raise error
    log.warning("%s", error)


def _expect_thresholds(summary: launch.RunSummary, settings: Settings) -> None:
    """Refuse a model without what stage 2 learned: the host moved or wrote files after it saved."""
    model, folder = summary.model_after, summary.output
    if not (summary.steps and settings.goal.learns and folder):
        return
    if model and (model.suffix != ".ply" or sidecar.find(model)):  # a checkpoint holds them itself
        return
    left = sorted(folder.rglob(f"*{sidecar.SUFFIX}"))
    if not model and (left or _in_checkpoints(folder)):
        return
    found = "no model was saved when stage 2 had ended"
    remedy = "Have the host save its model at its last iteration, and run it again."
    if model:
        found = f"{sidecar.path_beside(model).name} is not beside it"
        found += f"; in the folder there is {left[-1]}" if left else ""
        remedy = "Look where the host moved the model that it saved, and move the thresholds there."
    expected = "the thresholds that were learned"
    raise errors.SidecarError(str(model or folder), found, expected, remedy)


def _in_checkpoints(folder: Path) -> bool:
    """Whether the host keeps models in checkpoints of its own, which hold their thresholds."""
    return any(folder.glob("*.ckpt"))


@contextlib.contextmanager
def _enough_memory() -> Iterator[None]:
    """Inside, a GPU that is full ends no more than what is done here: the training matters more."""
    try:
        yield
    except torch.cuda.OutOfMemoryError as error:
        found = str(error).partition(". GPU")[0]
        expected = "room for the models that the host trained"
        remedy = "Compare them with fragprune compare, on a CPU if need be."
        raise NotComparedError("the GPU's memory", found, expected, remedy) from error


def figures_of(
    summary: launch.RunSummary,
    settings: Settings,
    looking: Looking,
    before: dict[str, Any] | None,
    after: dict[str, Any] | None,
    not_compared: FragpruneError | None = None,
    host_command: Sequence[str] = (),
) -> dict[str, Any]:
    """What --json prints of a run, from its measurements on held-out views."""
    trial, read = looking.trial, summary.photographs
    data: dict[str, Any] = {name: getattr(summary, name) for name in _OF_SUMMARY} | {
        "iterations": summary.steps,
        "gaussians_before": looking.gaussians,
        "training_views": {
            "fragments_per_pixel_before": summary.fragments_before,
            "fragments_per_pixel_after": summary.fragments_after,
        },
        "before": before,
        "after": after,
        "not_compared": not_compared and not_compared.as_dict(),
        "model_before": summary.model_before and str(summary.model_before),
        "model_after": summary.model_after and str(summary.model_after),
        "seen": looking.seen or (read is not None and not read.held_out),
        "keep": trial and trial.keep,
        "relocated": looking.lively.relocated,
        "forgotten": trial and trial.forgotten,
        "pressure": summary.curves[-1]["pressure"] if summary.curves else None,
        "seed": settings.seed,
        "host_options": _options(host_command),
    }
    of_folder = records.files(summary.output, below=True) if summary.output else []
    data["control"] = records.control_of(data, of_folder)
    return data


def _options(command: Sequence[str]) -> list[str]:
    """The words after a host's script that name no file: a control has the same, wherever it is."""
    scripts = [place for place, word in enumerate(command) if word.endswith(".py")]
    words = command[scripts[0] + 1 :] if scripts else command
    return sorted(word for word in words if not os.path.exists(word.rpartition("=")[2]))


def photographs_of(summary: launch.RunSummary) -> records.Recorded | None:
    """How to read the host's data and draw its models; None if they cannot be, or are measured.

    A host that holds nothing out is measured on the views that ``--eval`` would hold out.
    """
    if not summary.photographs:
        return None
    if summary.already_finished and summary.model_after and records.beside(summary.model_after):
        return None
    left = tuple(path for path in (summary.model_before, summary.model_after) if path)
    read = replace(summary.photographs, held_out=True)
    return records.Recorded(read, left, filtered=True, drawing=summary.drawing)


def measure_models(
    read: records.Recorded, engine: EngineOptions
) -> tuple[records.Recorded, list[dict[str, Any]]]:
    """Measure the models on held-out views, around the point and of the alpha that the first shows.

    Returns what was read, with how photographs were, and the figures of each model.
    """
    at = EngineOptions(engine.name, "cpu" if engine.device == "cpu" else "auto")
    rasterizer, where = opening.open_engine(at)  # on the host's device, if it can draw there
    models = [load(path, filtered=read.filtered, device=where) for path in read.models]
    host = _AsTheHost(rasterizer.name, rasterizer, read.drawing)
    photographs, dataset = matching.told_or_matched(models[0], read.photographs, host)
    candidates = [evaluate.Candidate(model, read.drawing) for model in models]
    figures = evaluate.measure_all(candidates, dataset.test, engine=rasterizer)
    return replace(read, photographs=photographs), figures


def _describe(summary: launch.RunSummary, data: dict[str, Any]) -> str:
    if summary.already_finished:
        return (
            f"{summary.model_after} is finished: stage 2 with these settings wrote it before, and "
            f"nothing was run. --again learns again.{_measured(summary)}"
        )
    if not summary.steps:
        return f"{summary.adapter}: the host ended; nothing was learned (--stage {summary.stage})."
    control = summary.settings["goal"] == records.CONTROL
    lines = [wording.describe(wording.columns_of(data)), ""] if data["after"] else []
    if data["before"]:
        lines.append(wording.outcome("run", data, data["control"]))
        lines += wording.begun(data)
    else:
        if data["after"] and not control:
            lines.append(_CONTROL)
        lines += wording.begun(data)
        if summary.fragments_before and summary.fragments_after:
            lines.append(wording.outcome_in_training(data))
        if data["not_compared"]:
            why = "{where}: {found}. {remedy}".format(**data["not_compared"])
            lines.append(f"Not compared on held-out views because of {why}")
    if data["after"] and summary.photographs and not summary.photographs.held_out:
        lines.append(_ALL_SEEN)
    pressure = f" at pressure {summary.curves[-1]['pressure']:.2g}" if summary.curves else ""
    within = "inside the training" if summary.stage == "joint" else "of stage 2"
    saved: Path | str | None = summary.model_after
    if saved is None:
        kept = summary.output and _in_checkpoints(summary.output)
        saved = f"the last checkpoint in {summary.output}" if kept else "not saved by the host"
    lines.append(
        f"{summary.adapter}, {summary.engine or 'host'} engine on {summary.device}: "
        f"{summary.steps} iterations {'of the control' if control else within}{pressure}, "
        f"{summary.train_seconds:.0f} s in all. Model: {saved}."
    )
    if summary.model_after and summary.output:
        scene = summary.photographs.folder if summary.photographs else None
        shown = _viewable(summary.model_after)
        if shown and shown.pruned and (beside := sidecar.find(summary.model_after)):
            lines.append(
                f"Its cutoffs lie beside it, in {beside.name}: without that it looks worse. To "
                f"have one: fragprune export {wording.quoted(summary.model_after)} --out pruned.ply"
            )
        look = summary.model_after if shown else None
        lines.append(wording.next_steps(look, summary.output, scene))
    return "\n".join(lines)


def _measured(summary: launch.RunSummary) -> str:
    """What a finished run measured, by its record, beside its control; a line to compare again."""
    assert summary.model_after is not None
    assert summary.output is not None
    record = records.beside(summary.model_after)
    if record is None or not record.data.get("before"):
        return ""
    control = records.control_of(record.data, records.files(summary.output, below=True))
    said = wording.outcome("run", record.data, control)
    both = " ".join(wording.quoted(model) for model in (summary.model_before, summary.model_after))
    return f"\n{said}\nCompare: fragprune compare {both}"


def _viewable(path: Path) -> Model | None:
    """The model, if its file shows what its host draws, so that ``fragprune view`` takes it."""
    try:
        return load(path)
    except FragpruneError:
        return None


@dataclass
class Looking:
    """What ``RunOptions.look`` calls."""

    engine: EngineOptions
    trial: Trial | None = None  # None where nothing could be tried
    gaussians: int = 0  # that the model had
    seen: bool = False  # whether the training of stage 1 has seen held-out views
    lively: Lively = field(default_factory=Lively)

    def __call__(
        self, ply: Path, photographs: Photographs, drawing: Mapping[str, Any], settings: Settings
    ) -> tuple[Settings, Tensor | None]:
        """Make the trial of ``fragprune finetune``, and score the Gaussians as it does."""
        told = output.arguments(ply)  # stage 2 writes its own over those of stage 1
        self.seen = told is not None and not told.held_out
        if other := output.read_otherwise(ply, photographs):
            said = "%s: its training had another %s (cfg_args); stage 2 learns by this command"
            log.warning(said, ply, ", ".join(other))
        try:
            with _enough_memory():
                return self._look(ply, photographs, drawing, settings)
        except FragpruneError as error:  # the host may read and draw more than we do
            log.warning("not tried whether it knows its photographs by heart, because of %s", error)
        gc.collect()  # a trial that was cut short: the host needs the GPU's memory now
        return settings, None

    def _look(
        self, ply: Path, photographs: Photographs, drawing: Mapping[str, Any], settings: Settings
    ) -> tuple[Settings, Tensor | None]:
        rasterizer, device = opening.open_engine(self.engine)
        engine = _AsTheHost(rasterizer.name, rasterizer, drawing)
        model = load(ply, filtered=True, device=device)
        self.lively.on, self.lively.rows = False, None
        _, dataset = matching.told_or_matched(model, photographs, engine)
        self.seen |= training.saw_held_out(ply, dataset)
        trial, left = tried(model, dataset, settings, engine=engine, say=log.info), None
        if trial.keep is not None:
            shots = dataset.train
            views = generated.views_near(shots, seed=settings.seed)
            scores = scored(model, views, engine=engine, progress=False)
            left = kept(model, trial.keep, shots, views, engine=engine, scores=scores).cpu()
            if trial.keep == "auto" and relocates(model, trial.settings):
                self.lively.rows = least(scores.cpu()[left])
        priced = trial.settings.goal.learns
        self.lively.views = [shot.view for shot in dataset.train] if priced else []
        self.lively.on = self.lively.rows is not None or bool(trial.settings.dropout)
        self.trial, self.gaussians = trial, len(model.xyz)
        return trial.settings, left


@dataclass
class _AsTheHost:
    """Draws with an engine, by a host's rules: these fields of ``RasterInputs``."""

    name: str
    engine: Engine
    drawing: Mapping[str, Any]

    def rasterize(self, inputs: RasterInputs, thresholds: Tensor | None) -> RasterOutputs:
        return self.engine.rasterize(replace(inputs, **self.drawing), thresholds)
