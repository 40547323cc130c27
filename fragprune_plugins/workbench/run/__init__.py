"""``fragprune run``: runs a host's training command and learns thresholds."""

from __future__ import annotations

import contextlib
import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fragprune_plugins.errors import FragpruneError, UsageError
from fragprune_plugins.files import records
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.workbench.commands.common import (
    JSON,
    Command,
    Report,
    bound_threads,
    config_option,
    device_option,
    engine_option,
    log_option,
    open_engine,
    threads_option,
)
from fragprune_plugins.workbench.commands.learning import again_option, learning_options

if TYPE_CHECKING:
    from fragprune_plugins.injection.launch import RunSummary


_WHERE = {"joint": "inside the training"}
_CONTROL = (
    "To see what truncation did, train as long with --stage off and another output folder, and run "
    "fragprune compare."
)
"""Joint learning has no model of before."""


@click.command(
    "run",
    cls=Command,
    context_settings={"ignore_unknown_options": True, "allow_interspersed_args": False},
)
@click.argument("host_command", nargs=-1, type=click.UNPROCESSED, metavar="-- python train.py ...")
@click.option("--adapter", help="Name of the host's adapter; default: detected from its source.")
@click.option(
    "--stage",
    type=click.Choice(["auto", "finetune", "joint", "off"]),
    default="auto",
    show_default=True,
    help="auto: train, then fine-tune. finetune: only fine-tune the model in the output folder. "
    "joint: learn inside the training. off: only apply stored thresholds.",
)
@click.option(
    "--from-iter",
    type=click.IntRange(min=0),
    help="finetune, joint: learn after this iteration; joint's default is the end of densification "
    "by the host's own arguments.",
)
@learning_options
@log_option
@config_option
@engine_option("Engine that rasterizes with thresholds, or if the host's own rasterizer is missing")
@device_option("Device of the host; cpu runs a CUDA-only host without a GPU.")
@threads_option
@click.option(
    "--evaluate/--no-evaluate",
    default=True,
    show_default=True,
    help="Compare before and after on the views that the host holds out (--eval).",
)
@again_option("Train, or learn, anew, though that is finished.")
@click.pass_context
def command(
    ctx: click.Context,
    host_command: tuple[str, ...],
    adapter: str | None,
    stage: Any,
    from_iter: int | None,
    settings: Settings,
    max_drop: float | None,
    engine: str,
    device: str,
    threads: int | None,
    evaluate: bool,
    again: bool,
) -> Report:
    """Train with a host's own command, then learn truncation thresholds.

    Put the unmodified command after --. Stage 1 is the host's own training. Stage 2 resumes it for
    a few thousand iterations, in which no Gaussian is added or removed. All parameters learn with
    the thresholds (but see --train). The host saves its model as usual, and the thresholds go
    beside it as a sidecar. In stage 2, Ctrl-C (exit code 130) and SIGTERM (143) save the thresholds
    learned so far. If stage 2 was interrupted or killed, the same command begins it anew and does
    not repeat stage 1.

    \b
    Examples:
      fragprune run -- python train.py -s scene -m out --eval
      fragprune run --quick --device cpu -- train.py -s scene -m out --iterations 7000
      fragprune run --stage finetune -- train.py -s scene -m out     (already trained)
      fragprune run --stage joint -- python train.py -s scene -m out   (no added iterations)
      fragprune run -- python render.py -m out                       (renders with thresholds)
    """
    if from_iter is not None and stage not in ("finetune", "joint"):
        raise UsageError(
            "--from-iter",
            f"--stage {stage}",
            "--stage finetune or joint, which learn inside one run",
            "Add one of them, or remove --from-iter.",
        )
    if settings.target_time is not None:
        raise UsageError(
            "--target-time",
            "fragprune run: a host keeps no model as it came in to time frames against",
            "--target-speedup, a ratio of fragments",
            "Use --target-speedup, or --target-time with fragprune finetune on the trained PLY.",
        )
    if max_drop is not None:
        raise UsageError(
            "--max-drop",
            "fragprune run: it would repeat the host's stage 2 many times",
            "a bound for fragprune finetune",
            "Use fragprune finetune with --max-drop on the trained PLY.",
        )

    from fragprune_plugins.injection.launch import RunOptions, run
    from fragprune_plugins.injection.process import current_gpu
    from fragprune_plugins.workbench.commands.logs import logging_steps

    bound_threads(threads)
    logging.basicConfig(level=logging.INFO, format="fragprune: %(message)s", stream=sys.stderr)
    options = RunOptions(
        adapter=adapter,
        stage=stage,
        settings=settings,
        from_iter=from_iter,
        engine=engine,
        device=device,
        again=again,
    )
    # A host prints to stdout; with --json, stdout gets only our object.
    to_stderr = contextlib.redirect_stdout(sys.stderr) if ctx.meta[JSON] else None
    with to_stderr or contextlib.nullcontext():
        with logging_steps([("bar", str(settings.iterations))]):
            summary = run(list(host_command), options)
        photographs = _photographs(summary)
        not_compared: FragpruneError | None = summary.not_compared
        before = after = None
        if photographs and evaluate:
            try:
                with current_gpu(device):
                    *first, after = _measure(photographs, engine, device)
                    before = first[0] if first else None
            except FragpruneError as error:  # the trained model is saved already
                not_compared = error
    data: dict[str, Any] = {
        "adapter": summary.adapter,
        "engine": summary.engine,
        "device": summary.device,
        "stage": summary.stage,
        "iterations": summary.iterations,
        "gaussians": summary.gaussians,
        "training_views": {
            "fragments_per_pixel_before": summary.fragments_before,
            "fragments_per_pixel_after": summary.fragments_after,
        },
        "before": before,
        "after": after,
        "not_compared": not_compared and not_compared.as_dict(),
        "model_before": _text(summary.model_before),
        "model_after": _text(summary.model_after),
        "pressure": summary.curves[-1]["pressure"] if summary.curves else None,
        "train_seconds": summary.train_seconds,
        "target_reached": summary.target_reached,
        "already_finished": summary.already_finished,
        "seed": settings.seed,
        "settings": summary.settings,
    }
    of_folder = records.files(summary.output, below=True) if summary.output else []
    data["control"] = records.control_of(data, of_folder)
    if summary.iterations and summary.model_after:
        more = {"curves": summary.curves, "photographs": photographs}
        records.leave(summary.model_after, "run", data | more)
    return Report(data, _describe(summary, data, not_compared))


def _saved(summary: RunSummary) -> str:
    """Where a model is that is no PLY."""
    kept = summary.output is not None and any(summary.output.glob("*.ckpt"))
    return f"the last checkpoint in {summary.output}" if kept else "not saved by the host"


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)


def _photographs(summary: RunSummary) -> dict[str, Any] | None:
    """The record's "photographs": how to read the host's data and draw its models.

    None if the models cannot be measured. Joint learning leaves one model.
    """
    left = [path for path in (summary.model_before, summary.model_after) if path]
    if not summary.photographs:
        return None
    return {
        **summary.photographs.as_dict(),
        "models": [str(path.resolve()) for path in left],
        "filtered": True,
        "drawing": summary.drawing,
    }


def _measure(
    photographs: dict[str, Any], engine: str = "auto", device: str = "auto"
) -> list[dict[str, Any]]:
    """Measure the models on held-out views, on the host's device if an engine can draw there.

    Args:
        photographs: the dict of ``_photographs``.
        engine: the ``--engine`` option.
        device: the ``--device`` option.

    Returns:
        The measurements before and after; after joint learning only those.
    """
    from fragprune_plugins.hosts.photographs import Photographs
    from fragprune_plugins.workbench.figures.evaluate import Candidate, measure_all
    from fragprune_plugins.workbench.models import model as models
    from fragprune_plugins.workbench.scenes.dataset import load_photographs

    rasterizer, where = open_engine(engine, "cpu" if device == "cpu" else "auto", None)
    dataset = load_photographs(Photographs.from_dict(photographs))
    left = [models.load(Path(path), filtered=True, device=where) for path in photographs["models"]]
    candidates = [Candidate(model, photographs["drawing"]) for model in left]
    return measure_all(candidates, dataset.test, engine=rasterizer)


def _describe(
    summary: RunSummary, data: dict[str, Any], not_compared: FragpruneError | None
) -> str:
    from fragprune_plugins.workbench.figures.wording import describe, fewer, missed, outcome

    if summary.already_finished:
        return (
            f"{summary.model_after} is finished: stage 2 with these settings wrote it before, and "
            f"nothing was run. --again learns again.\n"
            f"Compare: fragprune compare {summary.model_before} {summary.model_after}"
        )
    if not summary.iterations:
        return f"{summary.adapter}: the host ended; nothing was learned (--stage {summary.stage})."
    lines = []
    if data["before"]:
        columns = {"before": data["before"], "after": data["after"]}
        lines += [describe(columns), "", outcome("run", data, data["control"])]
    else:
        if data["after"]:
            lines += [describe({"after": data["after"]}), "", _CONTROL]
        if summary.fragments_before and summary.fragments_after:
            change = fewer(summary.fragments_before, summary.fragments_after)
            lines.append(
                f"{change} on training views; frame times were not measured.{missed(data)}"
            )
        if not_compared:
            why = f"{not_compared.where}: {not_compared.found}. {not_compared.remedy}"
            lines.append(f"Not compared on held-out views because of {why}")
        elif summary.photographs:
            models = f"{summary.model_before or 'OTHER'} {summary.model_after}"
            lines.append(f"Compare: fragprune compare {models}")
    pressure = f" at pressure {summary.curves[-1]['pressure']:.2g}" if summary.curves else ""
    control = not summary.settings["truncate"]
    learned = "of the control" if control else _WHERE.get(summary.stage, "of stage 2")
    lines.append(
        f"{summary.adapter}, {summary.engine or 'host'} engine on {summary.device}: "
        f"{summary.iterations} iterations {learned}{pressure}, "
        f"{summary.train_seconds:.0f} s in all. "
        f"Model: {summary.model_after or _saved(summary)}."
    )
    return "\n".join(lines)
