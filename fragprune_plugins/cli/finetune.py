"""``fragprune finetune``: learns a trained splat's thresholds from photographs, or from itself."""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from fragprune_plugins.cli.common import (
    FILE,
    Command,
    OutFile,
    Report,
    describe_dropped,
    dropping,
    engine_options,
    image_options,
    open_engine,
    require_place,
)
from fragprune_plugins.cli.learning import learning_options
from fragprune_plugins.errors import RecordError, SidecarError, UsageError
from fragprune_plugins.learning.interruption import EXIT_CODE, sigterm_interrupts
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.storage import models
from fragprune_plugins.storage.atomic import locked

if TYPE_CHECKING:
    from fragprune_plugins.datasets.dataset import Dataset
    from fragprune_plugins.engines import Engine
    from fragprune_plugins.finetuning import FinetuneResult


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
@click.argument("model", type=FILE)
@click.option(
    "--out", type=OutFile(".ply"), required=True, help="New .ply; its sidecar goes beside it."
)
@click.option(
    "--data",
    type=FILE,
    help="Scene folder: COLMAP (sparse/, images/) or Blender (transforms_*.json).",
)
@click.option(
    "--self",
    "itself",
    is_flag=True,
    help="Learn from MODEL's own pictures instead of photographs. Cameras: those of --data or "
    "--cameras; else all around MODEL, which suits an object. A scene seen from within (a room, a "
    "street) needs its own cameras: those around it see its walls from behind.",
)
@click.option(
    "--cameras",
    type=FILE,
    help="With --self: cameras.json of a 3DGS model, or transforms_*.json; every 8th is held out.",
)
@image_options
@learning_options
@click.option(
    "--keep",
    metavar="SHARE|auto",
    callback=_share,
    help="Before learning, remove Gaussians until this share is left, such as 0.8: first those "
    "whose removal changes the training views least. auto keeps what the photographs need. "
    "--target-speedup counts from what is left.",
)
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of the order of views.")
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
@click.option(
    "--checkpoint-every",
    "every",
    type=click.FloatRange(min=0),
    default=300.0,
    show_default=True,
    metavar="SECONDS",
    help="Keep the unfinished fine-tuning in OUT.fragprune-unfinished; 0 keeps it at Ctrl-C and "
    "SIGTERM only.",
)
@click.option(
    "--again", is_flag=True, help="Begin anew, though OUT is finished or there is a checkpoint."
)
@engine_options
def command(
    model: Path,
    out: Path,
    data: Path | None,
    itself: bool,
    cameras: Path | None,
    resolution: int,
    white_background: bool,
    settings: Settings,
    keep: float | Literal["auto"] | None,
    max_drop: float | None,
    seed: int,
    no_truncation: bool,
    curves: Path | None,
    drop: bool,
    every: float,
    again: bool,
    engine: str,
    device: str,
    threads: int | None,
) -> Report:
    """Learn how far each Gaussian of MODEL must reach.

    Thresholds and all other parameters adapt to each other on the photographs in --data. With
    --train opacity, positions, shapes and colours stay bit for bit. OUT has the columns of
    MODEL, and the thresholds go beside it into OUT.fragprune.safetensors. The table compares both
    models on held-out views. A line below it measures OUT without its thresholds, as other viewers
    draw it. Ctrl-C (exit code 130) and SIGTERM (143) save what was learned so far.

    The same command goes on where it was interrupted or killed. If OUT is finished already, it says
    so and does nothing; --again begins anew.

    With --portable no thresholds are learned: the Gaussians themselves cover less area, OUT needs
    no sidecar, and every viewer draws it as it is. "area/pixel" in the table is what most web
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
      fragprune finetune point_cloud.ply --self --cameras cameras.json --out pruned.ply
    """
    _require_target(data, itself, cameras, settings, max_drop)
    if itself and keep == "auto":
        raise UsageError(
            "options",
            "--self with --keep auto",
            "photographs, whose error says what can be spared",
            "Pass a share, such as --keep 0.9.",
        )
    require_place(out, model)
    click.get_current_context().with_resource(locked(out, wait=0, what="run"))

    from copy import deepcopy

    from fragprune_plugins.datasets.photographs import Photographs, Resolution
    from fragprune_plugins.finetuning import Checkpoints, finetune, load_dataset, resuming, save
    from fragprune_plugins.measure import Candidate, drop_invisible, measure
    from fragprune_plugins.measure.scores import keep_best, keep_needed
    from fragprune_plugins.measure.searching import strongest
    from fragprune_plugins.measure.wording import describe, outcome
    from fragprune_plugins.storage import records, sidecar

    def say(text: str) -> None:
        click.echo(text, err=True)

    rasterizer, where = open_engine(engine, device, threads)
    truncation = settings.truncate and not no_truncation
    splat, store = models.load(model, truncation=truncation, device=where)
    start = Candidate(splat, deepcopy(store))  # learning changes the store
    if itself:
        dataset = _own_pictures(
            models.Model(splat, store),
            data,
            cameras,
            resolution,
            white_background,
            seed,
            rasterizer,
        )
    else:
        assert data is not None
        dataset = load_dataset(data, resolution=resolution, white_background=white_background)

    checkpoints = Checkpoints(
        resuming.path_beside(out), every or None, tell=partial(click.echo, err=True)
    )
    asked = resuming.configuration(splat, store, dataset, settings, rasterizer.name)
    asked |= {"drop_invisible": drop, "keep": keep, "max_drop": max_drop}
    if again:
        checkpoints.clear()
    elif (finished := _finished(out, asked, curves)) is not None:
        checkpoints.clear()
        return finished
    cost = found = None
    if settings.target_time is not None:
        from fragprune_plugins.bench.calibration import prices_of

        cost = prices_of(rasterizer, where, say=say)
    with sigterm_interrupts():
        if keep is not None:
            shots, all_of_it = dataset.to(where).train, models.Model(splat, store)
            splat, store = (
                keep_needed(all_of_it, shots, engine=rasterizer, progress=True)
                if keep == "auto"
                else keep_best(
                    all_of_it, keep, [s.view for s in shots], engine=rasterizer, progress=True
                )
            )
        if max_drop is None:
            result = finetune(
                splat,
                dataset,
                settings,
                store=store,
                cost=cost,
                engine=rasterizer,
                progress=True,
                checkpoints=checkpoints,
            )
        else:
            found = strongest(
                splat,
                dataset,
                settings,
                max_drop,
                store=store,
                engine=rasterizer,
                progress=True,
                say=say,
            )
            result, settings = found.result, found.result.settings
        save(out, result)
    done = result.progress
    if result.terminated:  # after SIGTERM there is no time for measurements
        return _terminated(model, out, result, _GOES_ON if found is None else _BEGINS_ANEW)
    dropped = None
    if drop:
        whole = out.stat().st_size
        seen = [shot.view for shot in (*dataset.train, *dataset.test)]
        smaller, kept = drop_invisible(result.model, result.store, seen, engine=rasterizer)
        result = replace(result, model=smaller, store=kept)
        save(out, result)
        dropped = dropping(out, whole, len(splat), len(smaller))
    rows = [asdict(point) for point in result.curves]
    if curves is not None and rows:
        from fragprune_plugins.measure.report_page import save_learning

        save_learning(curves, rows, result.thresholds)
    candidates = [start, Candidate(result.model, result.store)]
    if result.thresholds is not None:
        candidates.append(Candidate(result.model))
    if found is not None:
        candidates.append(Candidate(found.control.model))
    before, after, *without = measure(candidates, dataset.test, engine=rasterizer)
    control = without.pop() if found is not None else None
    report = {
        "model": str(model),
        "out": str(out),
        "target": after["target"],
        "before": before,
        "after": after,
        "untruncated": without[0] if without else None,
        "keep": keep,
        "dropped": dropped,
        "speedup": done.speedup,
        "faster": done.faster,
        "target_reached": done.target_reached,
        "interrupted": result.interrupted,
        "resumed_at": result.resumed_at,
        "already_finished": False,
        "iterations": done.steps,
        "pressure": done.pressure if settings.truncate else None,
        "train_seconds": result.train_seconds,
        "engine": result.engine,
        "device": after["device"],
        "adapter": None,
        "seed": seed,
        "settings": settings.as_dict(),
        "max_drop": None if found is None else found.as_dict(max_drop or 0.0),
    }
    if control is None:
        control = records.control_of(report, records.files(out.parent))
    report["control"] = control
    pressure = f" at pressure {done.pressure:.2g}" if settings.truncate else ""
    lines = [
        describe({"before": before, "after": after}),
        "",
        outcome("finetune", report, control),
        f"{result.engine} engine, {done.steps} iterations{pressure} in "
        f"{result.train_seconds:.0f} s.",
    ]
    if found is not None:
        lines.append(_describe_bound(report["max_drop"], len(dataset.test)))
    if result.interrupted:
        goes_on = _GOES_ON if found is None else _BEGINS_ANEW
        lines.append(f"Interrupted at {done.steps} of {settings.iterations} iterations. {goes_on}")
    if keep is not None:
        gone, of = len(start.model) - len(splat), len(start.model)
        lines.append(
            f"Removed {gone:,} of {of:,} Gaussians before learning, those whose removal changed "
            "the training views least."
        )
    if dropped:
        lines.append(describe_dropped(dropped, f"which reach no pixel of the {len(seen)} views"))
    lines += [_describe_untruncated(before, plain) for plain in without]
    if settings.portable:
        lines.append(f"Wrote {out}, which needs no sidecar: every viewer draws it as it is.")
    else:
        together = " Keep the two together." if without else ""
        lines.append(f"Wrote {out} and {sidecar.path_beside(out).name}.{together}")
    more: dict[str, Any] = {"curves": rows}
    if not result.interrupted:
        more |= {"configuration": asked, "text": "\n".join(lines)}
    if data is not None:
        more["photographs"] = Photographs(
            data, Resolution(resolution), white_background
        ).as_dict() | {
            "models": [str(model.resolve()), str(out.resolve())],
            "filtered": False,
            "drawing": {},
        }
    records.leave(out, "finetune", report | more)
    if not result.interrupted:
        checkpoints.clear()  # not before: a kill while measuring goes on from it too
    return Report(report, "\n".join(lines), exit_code=130 if result.interrupted else 0)


_GOES_ON = "The same command goes on from there."
_BEGINS_ANEW = "With --max-drop the same command begins anew."


def _finished(out: Path, asked: dict[str, Any], curves: Path | None) -> Report | None:
    """The report of the same command, if it has written ``out`` already; else None."""
    from fragprune_plugins.storage import records, sidecar

    if not out.is_file():
        return None
    try:
        record = records.beside(out)
        plain = asked["portable"]
        alone = sidecar.find(out) is None if plain else sidecar.belongs(out)
        done = record is not None and record.command == "finetune" and alone
    except (RecordError, SidecarError):
        return None
    if record is None or not done or record.data.get("configuration") != asked:
        return None
    data = {key: value for key, value in record.data.items() if key not in _OF_RECORDS}
    if curves is not None and record.data["curves"]:
        from fragprune_plugins.measure.report_page import save_learning

        store = models.load(out).thresholds
        learned = None if store is None else store.values.detach()
        save_learning(curves, record.data["curves"], learned)
    text = (
        f"{record.data['text']}\n{out} was finished before: nothing was done. "
        "--again fine-tunes again."
    )
    return Report(data | {"already_finished": True}, text)


_OF_RECORDS = {"curves", "photographs", "configuration", "text"}


def _terminated(model: Path, out: Path, result: FinetuneResult, then: str) -> Report:
    """The report after SIGTERM: the model is saved, and nothing is measured."""
    done, asked = result.progress, result.settings
    data = {
        "model": str(model),
        "out": str(out),
        "before": None,
        "after": None,
        "interrupted": True,
        "iterations": done.steps,
        "train_seconds": result.train_seconds,
        "engine": result.engine,
        "settings": asked.as_dict(),
    }
    wrote = f"{out}" if asked.portable else f"{out} and its sidecar"
    text = f"SIGTERM at {done.steps} of {asked.iterations} iterations. Wrote {wrote}. {then}"
    return Report(data, text, exit_code=EXIT_CODE)


def _require_target(
    data: Path | None,
    itself: bool,
    cameras: Path | None,
    settings: Settings,
    max_drop: float | None,
) -> None:
    """Prove, before any work, that it is clear what MODEL must look like.

    Raises:
        UsageError: nothing says so, or two things do.
    """
    if not itself and cameras is not None:
        raise UsageError(
            "options",
            "--cameras without --self",
            "photographs, or the model's own pictures from those cameras",
            "Add --self, or pass --data FOLDER instead of --cameras.",
        )
    if not itself and data is None:
        raise UsageError(
            "options",
            "neither --data nor --self",
            "what to learn from",
            "Pass --data FOLDER with photographs; without any, --self.",
        )
    if data is not None and cameras is not None:
        raise UsageError(
            "options", "--data with --cameras", "one source of cameras", "Drop one of the two."
        )
    if itself and max_drop is not None:
        raise UsageError(
            "options",
            "--self with --max-drop",
            "photographs, and with them a control to lose against",
            "Drop --max-drop; --pressure steers what --self may lose.",
        )
    if itself and not settings.truncate:
        raise UsageError(
            "options",
            "--self with --control",
            "something to learn: without truncation the model is its own target already",
            "Drop --control; what it came in as is the comparison.",
        )


def _own_pictures(
    model: models.Model,
    data: Path | None,
    cameras: Path | None,
    resolution: int,
    white_background: bool,
    seed: int,
    engine: Engine,
) -> Dataset:
    """The pictures of a model from the cameras asked for."""
    import torch

    from fragprune_plugins.datasets.cameras import divided, load_cameras, load_scene_cameras
    from fragprune_plugins.datasets.generated import around
    from fragprune_plugins.finetuning import own_pictures

    held_out = None
    if data is not None:
        views, held_out = load_scene_cameras(data, white_background=white_background)
        held_out = divided(held_out, resolution)
    elif cameras is not None:
        views = load_cameras(cameras, white_background=white_background)
    else:
        views = around(model.splat, background=torch.full((3,), float(white_background)), seed=seed)
    return own_pictures(model, divided(views, resolution), held_out, engine=engine, seed=seed)


def _describe_bound(found: dict[str, Any], views: int) -> str:
    """A line on what --max-drop found."""
    if "loss" not in found:
        return "No training was compared with the control."
    tried = f"of {len(found['trials'])} trained"
    chosen = f"the strongest truncation {tried}" if found["met"] else f"the least loss {tried}"
    missed = "" if found["met"] else f" The bound of {found['bound']:g} dB was missed."
    return (
        f"Loss against the control: {found['loss']:.3f} dB at pressure {found['pressure']:.2g}, "
        f"{chosen}. The pressure was chosen on these {views} views; others of their kind may "
        f"differ by some {found['loss_se']:.2f} dB.{missed}"
    )


def _describe_untruncated(before: dict[str, Any], plain: dict[str, Any]) -> str:
    """A line on the fine-tuned model without its thresholds.

    Args:
        before: measurement of the model before fine-tuning.
        plain: measurement of the fine-tuned model without thresholds.
    """
    own = plain["target"] == "itself"
    compared = "against itself" if own else f"({plain['psnr'] - before['psnr']:+.2f})"
    from fragprune_plugins.measure.wording import FELL

    advice = ""
    if before["psnr"] is not None and plain["psnr"] < before["psnr"] - FELL:
        advice = " For viewers that ignore thresholds: --portable."
    return (
        f"Without its thresholds, as other viewers draw it: {plain['psnr']:.2f} dB PSNR "
        f"{compared}, {plain['fragments_per_pixel']:.1f} fragments "
        f"per pixel, {plain['frame_ms']:.2f} ± {plain['frame_ms_se']:.2f} ms a frame."
        f"{advice}"
    )
