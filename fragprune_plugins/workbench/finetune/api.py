"""Fine-tuning from Python: checks what comes in, and gives a goal what it needs."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import InputError, UsageError
from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.interruption import Terminate
from fragprune_plugins.learning.schedule import Schedule, Settings
from fragprune_plugins.plugins.hooks import engine_for, schedule_for
from fragprune_plugins.workbench.distributed import ShardedEngine, Shards
from fragprune_plugins.workbench.finetune.loop import FinetuneResult, Training
from fragprune_plugins.workbench.finetune.processes import Processes
from fragprune_plugins.workbench.finetune.relocation import relocates
from fragprune_plugins.workbench.finetune.resuming import Checkpoints
from fragprune_plugins.workbench.finetune.searching import strongest
from fragprune_plugins.workbench.goals import AtMost
from fragprune_plugins.workbench.models import model as models
from fragprune_plugins.workbench.ranks import Ranks
from fragprune_plugins.workbench.scenes.dataset import Dataset
from fragprune_plugins.workbench.scenes.generated import OwnPicture


def finetune(
    model: Model | models.Trained | str | Path,
    dataset: Dataset,
    settings: Settings | None = None,
    *,
    schedule: Schedule | None = None,
    engine: str | Engine = "auto",
    progress: bool = False,
    checkpoints: Checkpoints | None = None,
    ranks: Ranks | None = None,
    relocate: Tensor | None = None,
) -> FinetuneResult:
    """Learn the thresholds of a trained splat on its photographs; portable, its shapes.

    Loss: 0.8 L1 + 0.2 (1 - SSIM) + pressure x drawn fragments per pixel; portable, pressure x
    area of the ellipses per pixel. Views come in seeded random permutations; the global random
    streams are not touched.

    Args:
        model: what ``load`` gave, the result of another fine-tuning, or a file; not changed.
            Learning begins with its thresholds, or with neutral ones. Everything happens on its
            device.
        dataset: its photographs; only training views are learned from. Pixels stay in main memory
            and follow the model one view at a time.
        settings: iterations, what moves, the goal, or None; ``itself`` follows from the dataset.
        schedule: gives the plan of each step; when None a plugin's, or the default one.
        engine: a name or an engine.
        progress: draw a bar on stderr.
        checkpoints: where the unfinished fine-tuning is kept. If there is one of the same
            configuration, this goes on from it; on the cpu engine the result is then the same to
            the bit. Whoever saves the result clears them. ``AtMost`` keeps none.
        ranks: the processes that learn together (``ranks.joined``), each of which calls this with
            equal arguments and gets the same result; only the first writes checkpoints, draws the
            bar and tells observers. This one alone when None. With a ``ShardedEngine`` each passes
            its own Gaussians, and gets those back (``part_of``, ``whole_of``).
        relocate: (M,) int64, the rows of Gaussians that move to where some are missing (``spare``).

    Raises:
        EngineError: no such engine here.
        InputError: the dataset has no training view.
        CheckpointError: the checkpoint is broken, or another fine-tuning's.
        PluginError: a plugin raised, or gave an answer that cannot be used.
        UsageError: a target time that no thresholds reach; a portable goal for a model with
            thresholds; rows to relocate where none can move; a target time, or views that cannot
            be divided, in several processes.
        RanksError: another process is gone, or differs.
        DivergedError: NaN or infinity in what trains.
    """
    ranks, model = ranks or Ranks(), models.of(model)
    settings, device = Settings() if settings is None else settings, model.device
    engine = engine_for(engine, device)
    sharded = isinstance(engine, ShardedEngine)
    _expect_kinds(dataset, settings)
    if isinstance(dataset.train[0], OwnPicture):
        settings = replace(settings, itself=True)
    expect_fit(model, settings, moves=relocate is not None, sharded=sharded)
    dataset = dataset.to(device)
    if isinstance(settings.goal, AtMost):
        train = partial(finetune, model, dataset, engine=engine, progress=progress, ranks=ranks)
        return strongest(train, settings, dataset.test, engine=engine).result
    processes = Shards(ranks, len(model)) if sharded else Processes(ranks)
    processes.expect_able(settings)
    schedule = schedule or schedule_for(settings)
    training = Training(
        model, dataset, settings, schedule, engine, processes, checkpoints, relocate
    )
    return _learned(training, progress and ranks.first)


def _expect_kinds(dataset: Dataset, settings: Settings) -> None:
    """Raise InputError unless it is a data set to learn from, and settings."""
    for name, given, kind in (("dataset", dataset, Dataset), ("settings", settings, Settings)):
        if not isinstance(given, kind):
            remedy = "Pass load_dataset(FOLDER), and Settings(ITERATIONS)."
            raise InputError(f"finetune {name}", repr(given)[:80], f"a {kind.__name__}", remedy)
    if not dataset.train:
        raise InputError("dataset", "no training view", "at least one", "Pass photographs.")


def expect_fit(
    model: Model, settings: Settings, *, moves: bool = False, sharded: bool = False
) -> None:
    """Raise UsageError unless the model can become what is asked for."""
    if settings.goal.on_area and model.pruned:
        raise UsageError(
            "finetune",
            "a portable goal, and a model with thresholds or a stop",
            "a model without any: it is for viewers that ignore them",
            "Pass model.untruncated(), or --no-truncation on the command line.",
        )
    if settings.goal.on_area and model.scaling.shape[1] == 2:
        found, remedy = "a portable goal, and surfels (2 scales each)", "Choose another goal."
        raise UsageError("finetune", found, "3D Gaussians, as other viewers draw", remedy)
    if moves and (sharded or not relocates(model, settings)):
        found = "relocate, where positions stay, own pictures teach, or Gaussians are left out"
        expected = "all parameters of a model without 3D filter, learned from photographs"
        raise UsageError("finetune", found, expected, "Leave relocate out.")


def _learned(training: Training, progress: bool) -> FinetuneResult:
    """Learn to the end, or until a signal comes."""
    resumed, interrupted, terminated = training.done, False, False
    try:
        training.learn(progress)
    except KeyboardInterrupt as error:
        if training.processes.divided and not training.between:
            raise  # a second signal did not wait for the others, who hold the other parts
        interrupted, terminated = True, isinstance(error, Terminate)
        if training.between:
            training.keep()
    training.stage.check()
    count = training.processes.total(len(training.start))
    progress_made = replace(training.stage.progress(), steps=training.done, gaussians=count)
    result = FinetuneResult(
        model=training.result_model(),
        settings=training.settings,
        curves=training.curves,
        progress=progress_made,
        train_seconds=training.seconds,
        engine=training.engine.name,
        interrupted=interrupted,
        terminated=terminated,
        resumed_at=resumed,
        relocated=training.relocated,
    )
    training.end()
    return result
