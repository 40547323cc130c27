"""``fragprune experiment``: runs a named experiment."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fragprune_plugins.cli.common import (
    FILE,
    Command,
    Group,
    Report,
    data_options,
    engine_options,
    open_engine,
    together,
)
from fragprune_plugins.errors import UsageError
from fragprune_plugins.experiments.catalogue import EXPERIMENTS
from fragprune_plugins.learning.interruption import sigterm_interrupts
from fragprune_plugins.learning.schedule import FINETUNE_ITERATIONS

if TYPE_CHECKING:
    from fragprune_plugins.experiments.folder import Findings


@click.group("experiment", cls=Group, subcommand_metavar="NAME [ARGS]...")
def command() -> None:
    """Answer one question by a reproducible experiment.

    Each writes a table (Markdown and CSV), a plot and its exact configuration into a folder, and
    keeps what is finished in OUT/arms: after an interruption the same command does only what is
    missing. A folder that was begun in another configuration is refused.

    \b
    Examples:
      fragprune experiment rules point_cloud.ply --data scene --out experiments --seeds 0,1,2
      fragprune experiment overfitting --help
    """


def _seeds(ctx: click.Context, param: click.Parameter, value: str) -> tuple[int, ...]:
    """Whole numbers from a word such as "0,1,2", each once."""
    try:
        return tuple(dict.fromkeys(int(part) for part in value.split(",")))
    except ValueError as error:
        raise click.BadParameter(f"{value!r} is not a list such as 0,1,2.") from error


_out_option = click.option(
    "--out", type=FILE, required=True, help="Folder for the table, plot, configuration and arms."
)


def _seeds_option(default: str) -> Any:
    return click.option(
        "--seeds",
        default=default,
        show_default=True,
        metavar="N,N,...",
        callback=_seeds,
        help="Train every arm once for each of these seeds.",
    )


_training_options = together(
    click.argument("model", type=FILE),
    data_options,
    _out_option,
    click.option(
        "--iters",
        type=click.IntRange(min=1),
        help=f"Iterations of the longest arms; default {FINETUNE_ITERATIONS}.",
    ),
    click.option(
        "--scale",
        type=click.FloatRange(min=0, min_open=True),
        help="Multiply the default iterations by this instead.",
    ),
    click.option(
        "--train",
        type=click.Choice(["opacity", "appearance", "all"]),
        help="Parameters that move in every arm; default all. Not for moves.",
    ),
    _seeds_option("0"),
    engine_options,
)

_TRAINING = """{asks}

Trains MODEL in several ways and compares them on held-out views, with controls of equal length.
Frames are timed at the photographs' size and with sides four times as long.

\b
Example:
  fragprune experiment {name} point_cloud.ply --data scene --out experiments --seeds 0,1,2
"""


def _train(
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
    """Run an experiment that compares trainings."""
    if iters is not None and scale is not None:
        raise UsageError("options", "--iters with --scale", "one of the two", "Remove one.")
    longest = iters or max(1, round(FINETUNE_ITERATIONS * (1.0 if scale is None else scale)))
    experiment = EXPERIMENTS[name](longest, train)

    from fragprune_plugins.datasets.photographs import Photographs, Resolution
    from fragprune_plugins.experiments import results, running

    rasterizer, where = open_engine(engine, device, threads)
    photographs = Photographs(data, Resolution(resolution), white_background)
    with sigterm_interrupts():
        folder, outcomes = running.run(
            experiment,
            model,
            photographs,
            out,
            engine=rasterizer,
            device=where,
            seeds=seeds,
            progress=True,
        )
    return _report(results.findings(experiment, outcomes, folder))


def _report(found: Findings) -> Report:
    """Write what an experiment found, and report it."""
    files = found.publish()
    data = {
        "experiment": found.folder.name,
        "asks": found.asks,
        "rows": found.rows,
        "configuration": found.folder.asked,
        "files": [str(file) for file in files],
    }
    return Report(data, f"{found.asks}\n\n{found.table}\n\nWrote {', '.join(map(str, files))}.")


for _name, _make in EXPERIMENTS.items():
    _asks = _make(FINETUNE_ITERATIONS, None).asks
    command.command(
        _name, cls=Command, short_help=_asks, help=_TRAINING.format(asks=_asks, name=_name)
    )(_training_options(partial(_train, _name)))
