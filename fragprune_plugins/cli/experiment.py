"""``fragprune experiment``: runs a named comparison of trainings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from fragprune_plugins.cli.common import (
    FILE,
    Command,
    Report,
    data_options,
    engine_options,
    open_engine,
)
from fragprune_plugins.errors import UsageError
from fragprune_plugins.experiments.catalogue import EXPERIMENTS
from fragprune_plugins.learning.interruption import sigterm_interrupts
from fragprune_plugins.learning.schedule import FINETUNE_ITERATIONS


def _seeds(ctx: click.Context, param: click.Parameter, value: str) -> tuple[int, ...]:
    """Whole numbers from a word such as "0,1,2", each once."""
    try:
        return tuple(dict.fromkeys(int(part) for part in value.split(",")))
    except ValueError as error:
        raise click.BadParameter(f"{value!r} is not a list such as 0,1,2.") from error


@click.command("experiment", cls=Command)
@click.argument("name", type=click.Choice(list(EXPERIMENTS)))
@click.argument("model", type=FILE)
@data_options
@click.option(
    "--out", type=FILE, required=True, help="Folder for the table, plot, configuration and arms."
)
@click.option(
    "--iters",
    type=click.IntRange(min=1),
    help=f"Iterations of the longest arms; default {FINETUNE_ITERATIONS}.",
)
@click.option(
    "--scale",
    type=click.FloatRange(min=0, min_open=True),
    help="Multiply the default iterations by this instead.",
)
@click.option(
    "--train",
    type=click.Choice(["opacity", "appearance", "all"]),
    help="Parameters that move in every arm; default all. Not for moves.",
)
@click.option(
    "--seeds",
    default="0",
    show_default=True,
    metavar="N,N,...",
    callback=_seeds,
    help="Train every arm once for each of these seeds.",
)
@engine_options
def command(
    name: str,
    model: Path,
    data: Path,
    resolution: int,
    white_background: bool,
    out: Path,
    iters: int | None,
    scale: float | None,
    train: Any,
    seeds: tuple[int, ...],
    engine: str,
    device: str,
    threads: int | None,
) -> Report:
    """Train MODEL in several ways and compare them on held-out views.

    \b
    rules       learned thresholds, one falloff threshold for all, one alpha cut-off for all
    moves       what moves: opacity, appearance or all
    iterations  a 25th, a fifth and all of the iterations

    Every experiment trains controls of equal length. Frames are timed at the photographs' size and
    with sides four times as long. Each finished arm is kept in OUT/arms: after an interruption the
    same command does only what is missing. A folder that was begun in another configuration is
    refused.

    \b
    Examples:
      fragprune experiment rules point_cloud.ply --data scene --out experiments --seeds 0,1,2
      fragprune experiment iterations point_cloud.ply --data scene --out experiments --scale 0.2
    """
    if iters is not None and scale is not None:
        raise UsageError("options", "--iters with --scale", "one of the two", "Remove one.")
    longest = iters or max(1, round(FINETUNE_ITERATIONS * (1.0 if scale is None else scale)))
    experiment = EXPERIMENTS[name](longest, train)

    from fragprune_plugins.datasets.photographs import Photographs, Resolution
    from fragprune_plugins.experiments import results, running

    rasterizer, where = open_engine(engine, device, threads)
    photographs = Photographs(data, Resolution(resolution), white_background)
    with sigterm_interrupts():
        asked, outcomes = running.run(
            experiment,
            model,
            photographs,
            out,
            engine=rasterizer,
            device=where,
            seeds=seeds,
            progress=True,
        )
    table = results.rows(experiment, outcomes)
    files = [*results.write(out, experiment, table, asked), out / f"{name}.json"]
    report = {
        "experiment": name,
        "asks": experiment.asks,
        "rows": table,
        "configuration": asked,
        "files": [str(file) for file in files],
    }
    text = f"{experiment.asks}\n\n{results.markdown(table)}\n\nWrote {', '.join(map(str, files))}."
    return Report(report, text)
