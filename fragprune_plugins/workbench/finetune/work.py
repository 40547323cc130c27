"""Fine-tunes a model file: opens what is asked for, learns, saves, measures and reports."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import click
from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.engines.cpu.memory import keep_freed_memory
from fragprune_plugins.errors import UsageError, printable
from fragprune_plugins.files.atomic import locked
from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.interruption import sigterm_interrupts
from fragprune_plugins.workbench.commands import opening, options
from fragprune_plugins.workbench.commands.command import Report
from fragprune_plugins.workbench.distributed import ShardedEngine, part_of, whole_of
from fragprune_plugins.workbench.figures import records
from fragprune_plugins.workbench.figures.evaluate import Candidate
from fragprune_plugins.workbench.figures.matching import OTHER_SCENE, matched, shown_and_plain
from fragprune_plugins.workbench.figures.metrics import expect_window
from fragprune_plugins.workbench.finetune import api, resuming
from fragprune_plugins.workbench.finetune.finished import Asked, Finetuned, Opened, finished
from fragprune_plugins.workbench.finetune.relocation import least, relocates
from fragprune_plugins.workbench.finetune.resuming import Checkpoints
from fragprune_plugins.workbench.finetune.searching import strongest
from fragprune_plugins.workbench.finetune.trial import tried
from fragprune_plugins.workbench.goals import AtMost
from fragprune_plugins.workbench.models import model as models
from fragprune_plugins.workbench.models.model import require_place
from fragprune_plugins.workbench.pruning import kept, scored
from fragprune_plugins.workbench.ranks import Ranks, joined, launched
from fragprune_plugins.workbench.scenes.dataset import Dataset, load_photographs
from fragprune_plugins.workbench.scenes.generated import views_near
from fragprune_plugins.workbench.scenes.output import CAMERAS
from fragprune_plugins.workbench.scenes.training import exposed, moved, saw_held_out

_say = partial(click.echo, err=True)


def finetune(**fields: Any) -> Report | None:
    """Fine-tune, with the fields of ``Asked``; the report, in the first process."""
    asked = Asked(**fields)
    if asked.shard:
        options.require_several()
    if launched().first:
        require_place(asked.out, asked.model, thresholds=asked.settings.goal.learns)
        lock = locked(asked.out, wait=0, what="run")
        click.get_current_context().with_resource(lock)
    opened = _open(asked)
    with sigterm_interrupts():
        with joined(opened.device) as ranks:
            if ranks.first and asked.again:
                opened.checkpoints.clear()
            known = finished(opened) if ranks.first and not asked.again else None
            if ranks.gather(known is not None)[0]:
                opened.checkpoints.clear()
                return known
            for shot in opened.dataset.test:  # what cannot be measured shows before the learning
                expect_window(shot.unkept().image)
            chosen, lost = _tried(opened)
            over, engine = _learned(chosen, ranks, lost)
            measured = None
            if asked.shard and not over.result.terminated:  # all draw, so all measure
                measured = over.measured(engine)
        if not ranks.first:
            return None
    if over.result.terminated:  # after SIGTERM there is no time for measurements
        return over.terminated()
    report = over.report(measured or over.measured(opened.engine))
    if report.exit_code == 0:  # not before: a kill while measuring goes on from it too
        opened.checkpoints.clear()
    return report


def _open(asked: Asked) -> Opened:
    """Read the model and its photographs, or draw its pictures."""
    scene, settings, photographs = asked.scene, asked.settings, None
    if scene.data is not None or not asked.itself:
        remedy = "Pass --data FOLDER with photographs; without any, --self."
        photographs = asked.photographs or opening.photographs_for(
            asked.model, scene, remedy=remedy
        )
        if not asked.itself and (name := exposed(asked.model)):
            found = f"its training learned an exposure for {name}: exposure.json"
            expected = "a model whose pictures are like its photographs as they are"
            raise UsageError("MODEL", found, expected, "Learn from its own pictures: --self.")
    engine, device = opening.open_engine(asked.engine)
    keep_freed_memory()
    truncation = settings.goal.presses and not asked.no_truncation
    where = "cpu" if asked.shard else device
    whole = models.load(asked.model, truncation=truncation, device=where)
    api.expect_fit(whole, settings)
    opening.warn_if_antialiased(asked.model)
    if asked.itself:
        own = opening.own_cameras_for(asked.model, scene, asked.cameras, asked.seed)
        asked = replace(asked, scene=own.scene, cameras=own.cameras)
        dataset = own.pictures(whole, engine)
    else:
        assert photographs is not None
        if asked.shard:
            dataset = load_photographs(photographs)
        else:
            photographs, dataset = matched(whole, photographs, engine)
    checkpoints = Checkpoints(resuming.path_beside(asked.out), resuming.EVERY, tell=_say)
    configuration = resuming.configuration(whole, dataset, settings, engine.name)
    configuration |= {"keep": asked.keep} | ({"sharded": True} if asked.shard else {})
    seen = not asked.itself and saw_held_out(asked.model, dataset)
    return Opened(
        asked, whole, photographs, dataset, engine, device, checkpoints, configuration, seen
    )


def _tried(opened: Opened) -> tuple[Opened, float | None]:
    """What a trial found, and the same with what it chose: dropout, and Gaussians to keep.

    In several processes the trials would have to agree, so none is made.
    """
    if launched().size > 1:
        return opened, None
    asked, dataset = opened.asked, opened.dataset.to(opened.device)
    _warn_of_another_scene(opened, dataset)
    trial = tried(opened.whole, dataset, asked.settings, asked.keep, engine=opened.engine, say=_say)
    asked = replace(asked, settings=trial.settings, keep=trial.keep)
    return replace(opened, asked=asked), trial.forgotten


def _warn_of_another_scene(opened: Opened, dataset: Dataset) -> None:
    """Warn before the learning of photographs that the model does not show."""
    if opened.asked.itself:
        return
    showing, plain = shown_and_plain(opened.whole, dataset, opened.engine)
    if showing < plain + OTHER_SCENE:
        _say(
            f"warning: MODEL shows its photographs at {showing:.1f} dB PSNR, and pictures of one "
            f"colour each at {plain:.1f}, as if they were of another scene. Check --data, "
            "--images, --resolution and --white-background. If an editor or nerfstudio has moved, "
            "turned or scaled MODEL, learn from its own pictures with --self."
        )
    if name := moved(opened.asked.model, dataset):
        _say(
            f"warning: in the training of MODEL the camera of {printable(name)} was elsewhere, by "
            f"its {CAMERAS}: a model must not learn photographs from cameras other than its own. "
            "Check --data, or learn from its own pictures with --self."
        )


def _learned(opened: Opened, ranks: Ranks, lost: float | None) -> tuple[Finetuned, Engine]:
    """Learn with the other processes, save the result; also the engine that draws it."""
    asked, whole, engine, dataset = opened.asked, opened.whole, opened.engine, opened.dataset
    settings, found, count = asked.settings, None, len(whole)
    if asked.shard:
        whole, engine = part_of(whole, ranks, opened.device), ShardedEngine(engine, ranks)
    start = Candidate(whole, gaussians=count)
    left, rows = _keep(whole, asked, dataset.to(opened.device), engine)
    train = partial(api.finetune, left, dataset, engine=engine, progress=True, ranks=ranks)
    if isinstance(settings.goal, AtMost):
        found = strongest(train, settings, dataset.test, engine=engine, say=_say)
        result = found.result
    else:
        result = train(settings, checkpoints=opened.checkpoints, relocate=rows)
    saved = whole_of(result.model, ranks) if asked.shard else result.model
    if ranks.first:
        records.path_beside(asked.out).unlink(missing_ok=True)  # of the file that was there
        models.save(asked.out, saved)
    truncated, shards = ranks.gather(saved.falloff is not None)[0], ranks.size if asked.shard else 1
    return Finetuned(opened, start, result, lost, found, truncated, shards), engine


def _keep(
    whole: Model, asked: Asked, dataset: Dataset, engine: Engine
) -> tuple[Model, Tensor | None]:
    """The Gaussians that --keep leaves, for what training views and cameras beside them show.

    Of those that auto leaves also the rows of some that may move to where others are missing.
    """
    if asked.keep in (None, 1):
        return whole, None
    shots = dataset.train
    if asked.keep == "visible":
        views = [shot.view for shot in (*shots, *dataset.test)]
    elif asked.itself:  # own pictures lie between all cameras already
        views = [shot.view for shot in shots]
    else:
        views = views_near(shots, seed=asked.seed)
    scores = scored(whole, views, engine=engine, progress=True) if asked.keep == "auto" else None
    stays = kept(whole, asked.keep, shots, views, engine=engine, progress=True, scores=scores)
    if scores is None or not relocates(whole, asked.settings):
        return whole.keep(stays), None
    return whole.keep(stays), least(scores[stays])
