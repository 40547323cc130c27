"""``fragprune finetune``: learns a trained splat's thresholds from photographs, or from itself."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from fragprune_plugins.errors import UsageError
from fragprune_plugins.files.atomic import locked
from fragprune_plugins.learning.goals import AtMost, Control, Faster
from fragprune_plugins.learning.interruption import sigterm_interrupts
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.workbench.commands.command import Command, Report, first_process_prints
from fragprune_plugins.workbench.commands.config import config_option
from fragprune_plugins.workbench.commands.learning import learning_options, resuming_options
from fragprune_plugins.workbench.commands.logs import log_option
from fragprune_plugins.workbench.commands.options import (
    FILE,
    MODEL,
    EngineOptions,
    OutFile,
    SceneOptions,
    engine_options,
    require_several,
    scene_options,
    shard_option,
)
from fragprune_plugins.workbench.models import formats
from fragprune_plugins.workbench.models import model as models
from fragprune_plugins.workbench.models.written import dropping, require_place
from fragprune_plugins.workbench.ranks import Ranks, joined, launched

if TYPE_CHECKING:
    from fragprune_plugins.engines import Engine
    from fragprune_plugins.files.model import Model
    from fragprune_plugins.workbench.finetune.api import FinetuneResult
    from fragprune_plugins.workbench.finetune.resuming import Checkpoints
    from fragprune_plugins.workbench.finetune.searching import Bounded
    from fragprune_plugins.workbench.scenes.dataset import Dataset


def _share(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> float | Literal["auto"] | None:
    """A share in (0, 1], or auto."""
    if value is None:
        return None
    if value == "auto":
        return "auto"
    try:
        share = float(value)
    except ValueError:
        share = 0.0
    if not 0 < share <= 1:
        raise click.BadParameter(f"{value!r} is neither auto nor a number with 0 < X <= 1.")
    return share


@click.command("finetune", cls=Command)
@click.argument("model", type=MODEL)
@click.option(
    "--out",
    type=OutFile(*formats.ENDINGS),
    required=True,
    help="New model: .ply, .spz, .sog or .glb, which hold its thresholds. .splat and "
    ".compressed.ply cannot hold any.",
)
@click.option(
    "--self",
    "itself",
    is_flag=True,
    help="Learn from MODEL's own pictures instead of photographs. Cameras: those of --data or "
    "--cameras; else all around MODEL, which suits an object. Indoor scenes "
    "and streets need --cameras: generated ones stay outside.",
)
@click.option(
    "--cameras",
    type=FILE,
    help="With --self: cameras.json of a 3DGS model, or transforms_*.json; every 8th is held out.",
)
@scene_options()
@learning_options(every_goal=True)
@log_option
@config_option
@click.option(
    "--keep",
    metavar="SHARE|auto",
    callback=_share,
    help="Before learning, remove Gaussians until this share is left, such as 0.8: first those "
    "whose removal changes the training views least. auto keeps what the photographs need. "
    "--target-speedup counts from what is left.",
)
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of the order of views.")
@click.option(
    "--views-per-step",
    type=click.IntRange(min=1),
    default=lambda: launched().size,
    show_default="one for each process",
    metavar="N",
    help="Views whose mean loss a step descends on. Without --iters, steps are N times fewer; "
    "learning rates are the square root of N times higher. More than one serves several "
    "processes under torchrun, which draw them side by side.",
)
@shard_option
@click.option("--no-truncation", is_flag=True, help="Ignore thresholds stored with MODEL.")
@click.option(
    "--curves", type=OutFile(".png"), help="File for a picture of the learning curves (.png)."
)
@click.option(
    "--drop-invisible",
    "drop",
    is_flag=True,
    help="Leave out Gaussians that reach no pixel of any training or held-out view.",
)
@resuming_options(
    "Keep the unfinished fine-tuning in OUT.fragprune-unfinished; 0 keeps it at Ctrl-C and "
    "SIGTERM only.",
)
@engine_options()
@first_process_prints()
def command(
    model: Path,
    out: Path,
    itself: bool,
    cameras: Path | None,
    scene: SceneOptions,
    settings: Settings,
    keep: float | Literal["auto"] | None,
    seed: int,
    shard: bool,
    no_truncation: bool,
    curves: Path | None,
    drop: bool,
    every: float,
    again: bool,
    engine: EngineOptions,
) -> Report | None:
    """Learn how far each Gaussian of MODEL must reach.

    Thresholds and all other parameters adapt to each other on the photographs in --data. With
    --train opacity, positions, shapes and colours stay bit for bit. OUT has the columns of
    MODEL, and one more for the thresholds, trunc_threshold. The table compares both models on
    held-out views. A line below it measures OUT without its thresholds, as other viewers draw it.
    Ctrl-C (exit code 130) and SIGTERM (143) save what was learned so far.

    The same command goes on where it was interrupted or killed. If OUT is finished already, it says
    so and does nothing; --again begins anew.

    With --portable no thresholds are learned: the Gaussians themselves cover less area, and every
    viewer draws OUT as it is. "area/pixel" in the table is what most web
    viewers pay for: the pixels in all ellipses of sqrt(8) standard deviations.

    With --self no photograph is read: MODEL's own pictures are what it must go on showing, also
    between the cameras. PSNR is against those pictures then. The defaults are 1000 iterations at
    --pressure 1.5e-4.

    \b
    Examples:
      fragprune finetune point_cloud.ply --data scene --out pruned.ply --quick
      fragprune finetune point_cloud.ply --data scene --out half.ply --target-speedup 2
      fragprune finetune point_cloud.ply --data scene --out fast.ply --target-time 1.4
      fragprune finetune point_cloud.ply --data scene --out good.ply --max-drop 0.05
      fragprune finetune point_cloud.ply --data scene --out zero.ply --control
      fragprune finetune point_cloud.ply --data scene --out light.ply --portable
      fragprune finetune statue.ply --self --out pruned.ply
      fragprune finetune statue.spz --self --out pruned.spz
      fragprune finetune point_cloud.ply --self --cameras cameras.json --out pruned.ply
    """
    _require_sense(scene.data, itself, cameras, settings, keep)
    if shard:
        _require_shards(settings, itself, keep, drop)
    if launched().first:
        require_place(out, model, thresholds=settings.goal.learns)
        click.get_current_context().with_resource(locked(out, wait=0, what="run"))

    from fragprune_plugins.engines.cpu.memory import keep_freed_memory
    from fragprune_plugins.workbench.commands.opening import (
        open_engine,
        photographs_for,
        pictures_of,
    )
    from fragprune_plugins.workbench.distributed.processes import part_of
    from fragprune_plugins.workbench.distributed.sharded import ShardedEngine
    from fragprune_plugins.workbench.figures.evaluate import Candidate
    from fragprune_plugins.workbench.finetune import finished as finetuned
    from fragprune_plugins.workbench.finetune import resuming
    from fragprune_plugins.workbench.finetune.resuming import Checkpoints
    from fragprune_plugins.workbench.scenes.dataset import load_photographs

    photographs = None
    if scene.data is not None or not itself:
        remedy = "Pass --data FOLDER with photographs; without any, --self."
        photographs = photographs_for(model, scene, remedy=remedy)
    rasterizer, where = open_engine(engine)
    keep_freed_memory()
    truncation = settings.goal.presses and not no_truncation
    whole = models.load(model, truncation=truncation, device="cpu" if shard else where)
    if itself:
        dataset = pictures_of(whole, scene, cameras, rasterizer, seed=seed)
    else:
        assert photographs is not None
        dataset = load_photographs(photographs)

    checkpoints = Checkpoints(resuming.path_beside(out), every or None, tell=_say)
    asked = resuming.configuration(whole, dataset, settings, rasterizer.name)
    asked |= {"drop_invisible": drop, "keep": keep}
    asked |= {"sharded": True} if shard else {}
    with sigterm_interrupts():
        with joined(where) as ranks:
            finished = None
            if again and ranks.first:
                checkpoints.clear()
            elif ranks.first:
                finished = finetuned.finished(model, out, asked, curves)
            if ranks.gather(finished is not None)[0]:
                checkpoints.clear()
                return finished
            count = len(whole)
            if shard:
                whole, rasterizer = part_of(whole, ranks, where), ShardedEngine(rasterizer, ranks)
            start = Candidate(whole, gaussians=count)
            kept = _keep(whole, keep, dataset.to(where), rasterizer)
            result, found = _learn(kept, dataset, settings, rasterizer, checkpoints, ranks)
            saved = _whole(result, ranks) if shard else result
            if ranks.first:
                models.save(out, saved)
            truncated = saved.model.falloff is not None
            over = finetuned.Finetuned(
                model=model,
                out=out,
                start=start,
                result=result,
                keep=keep,
                removed=len(whole) - len(kept),
                found=found,
                dropped=None,
                seed=seed,
                truncated=ranks.gather(truncated)[0] if shard else truncated,
                shards=ranks.size if shard else 1,
            )
            measured = None
            if shard and not result.terminated:  # all draw, so all measure
                measured = over.measured(dataset, rasterizer)
        if not ranks.first:
            return None
    if result.terminated:  # after SIGTERM there is no time for measurements
        return finetuned.terminated(model, out, result, found)
    if drop:
        saved, dropped = _drop_invisible(out, result, dataset, rasterizer)
        over = replace(over, result=saved, dropped=dropped)
    if curves is not None:
        points = [asdict(point) for point in result.curves]
        finetuned.draw_curves(curves, points, saved.model.falloff)
    figures = measured or over.measured(dataset, rasterizer)
    pictures = scene.as_record(cameras) if itself else None
    report = over.report(figures, dataset, photographs, asked, pictures)
    if not result.interrupted:
        checkpoints.clear()  # not before: a kill while measuring goes on from it too
    return report


def _say(text: str) -> None:
    click.echo(text, err=True)


def _keep(
    whole: Model, keep: float | Literal["auto"] | None, dataset: Dataset, engine: Engine
) -> Model:
    """The Gaussians that --keep leaves."""
    from fragprune_plugins.workbench.pruning.scores import keep_best, keep_needed

    if keep is None:
        return whole
    if keep == "auto":
        return keep_needed(whole, dataset.train, engine=engine, progress=True)
    views = [shot.view for shot in dataset.train]
    return keep_best(whole, keep, views, engine=engine, progress=True)


def _learn(
    model: Model,
    dataset: Dataset,
    settings: Settings,
    engine: Engine,
    checkpoints: Checkpoints,
    ranks: Ranks,
) -> tuple[FinetuneResult, Bounded | None]:
    """Fine-tune once, or as often as a bound on the loss needs."""
    from fragprune_plugins.workbench.finetune.api import finetune
    from fragprune_plugins.workbench.finetune.searching import strongest
    from fragprune_plugins.workbench.prices.target import frame_target

    options: dict[str, Any] = {"engine": engine, "progress": True, "ranks": ranks}
    if isinstance(settings.goal, AtMost):
        found = strongest(model, dataset, settings, say=_say, **options)
        return found.result, found
    target = None
    if isinstance(settings.goal, Faster):
        target = frame_target(settings.goal.ratio, engine, model.device, say=_say)
    options |= {"target": target, "checkpoints": checkpoints}
    return finetune(model, dataset, settings, **options), None


def _whole(result: FinetuneResult, ranks: Ranks) -> FinetuneResult:
    """The result with all Gaussians, in the first process; as it is in others."""
    from fragprune_plugins.workbench.distributed.processes import whole_of

    whole = whole_of(result.model, ranks)
    return replace(result, model=whole) if ranks.first else result


def _drop_invisible(
    out: Path, result: FinetuneResult, dataset: Dataset, engine: Engine
) -> tuple[FinetuneResult, dict[str, int]]:
    """Write the result again without Gaussians that no view shows; also give the counts."""
    from fragprune_plugins.workbench.pruning.visibility import visible

    size, views = out.stat().st_size, [shot.view for shot in (*dataset.train, *dataset.test)]
    left = replace(result, model=result.model.keep(visible(result.model, views, engine=engine)))
    models.save(out, left)
    return left, dropping(out, size, len(result.model), len(left.model))


def _require_sense(
    data: Path | None,
    itself: bool,
    cameras: Path | None,
    settings: Settings,
    keep: float | Literal["auto"] | None,
) -> None:
    """Prove, before any work, that it is clear what MODEL must look like.

    Raises:
        UsageError: nothing says so, two things do, or an option needs photographs.
    """
    if not itself and cameras is not None:
        raise UsageError(
            "options",
            "--cameras without --self",
            "photographs, or the model's own pictures from those cameras",
            "Add --self, or pass --data FOLDER instead of --cameras.",
        )
    if data is not None and cameras is not None:
        raise UsageError(
            "options", "--data with --cameras", "one source of cameras", "Drop one of the two."
        )
    if itself and isinstance(settings.goal, AtMost):
        raise UsageError(
            "options",
            "--self with --max-drop",
            "photographs, and with them a control to lose against",
            "Drop --max-drop; --pressure steers what --self may lose.",
        )
    if itself and isinstance(settings.goal, Control):
        raise UsageError(
            "options",
            "--self with --control",
            "something to learn: without truncation the model is its own target already",
            "Drop --control; what it came in as is the comparison.",
        )
    if itself and keep == "auto":
        raise UsageError(
            "options",
            "--self with --keep auto",
            "photographs, whose error says what can be spared",
            "Pass a share, such as --keep 0.9.",
        )


def _require_shards(
    settings: Settings,
    itself: bool,
    keep: float | Literal["auto"] | None,
    drop: bool,
) -> None:
    """Check that Gaussians which are divided among processes can learn what is asked for.

    Raises:
        UsageError: there is one process, or an option needs the whole model.
    """
    require_several()
    asked = {
        "--self": itself,
        "--portable": settings.goal.on_area,
        "--max-drop": isinstance(settings.goal, AtMost),
        "--keep": keep is not None,
        "--drop-invisible": drop,
    }
    if found := [name for name, given in asked.items() if given]:
        raise UsageError(
            "options",
            f"--shard-gaussians with {', '.join(found)}",
            "options that each process can follow with a part of the Gaussians",
            "Leave one of them out.",
        )
