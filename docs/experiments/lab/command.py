"""The command line of the lab: runs a named experiment."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fragprune_plugins.learning.interruption import sigterm_interrupts
from fragprune_plugins.learning.schedule import FINETUNE_ITERATIONS, Settings
from fragprune_plugins.workbench.commands.command import Command, Group, Report
from fragprune_plugins.workbench.commands.opening import open_engine, photographs_for
from fragprune_plugins.workbench.commands.options import (
    FILE,
    MODEL,
    EngineOptions,
    Number,
    SceneOptions,
    bundled,
    engine_options,
    scene_options,
)
from fragprune_plugins.workbench.commands.rules import Alone
from lab.catalogue import EXPERIMENTS, QUESTIONS

if TYPE_CHECKING:
    from lab.folder import Findings


@click.group(cls=Group, subcommand_metavar="NAME [ARGS]...")
def command() -> None:
    """Answer one question by a reproducible experiment.

    Each writes a table (Markdown and CSV), a plot and its exact configuration into a folder, and
    keeps what is finished in OUT/arms: after an interruption the same command does only what is
    missing. A folder that was begun in another configuration is refused.

    \b
    Examples:
      python -m lab rules point_cloud.ply --data scene --out experiments --seeds 0,1,2
      python -m lab overfitting --help
    """


def _seeds(ctx: click.Context, param: click.Parameter, value: str) -> tuple[int, ...]:
    """Whole numbers from a word such as "0,1,2", each once."""
    try:
        return tuple(dict.fromkeys(int(part) for part in value.split(",")))
    except ValueError as error:
        raise click.BadParameter(f"{value!r} is not a list such as 0,1,2.") from error


def _as_given(options: dict[str, Any]) -> dict[str, Any]:
    """Nothing is made of the options: a command gets each by its name."""
    return {}


_out_option = click.option(
    "--out", type=FILE, required=True, help="Folder for the table, plot, configuration and arms."
)


_training_options = bundled(
    _as_given,
    click.argument("model", type=MODEL),
    scene_options(),
    _out_option,
    click.option(
        "--iters",
        type=click.IntRange(min=1),
        help=f"Iterations of the longest arms; default {FINETUNE_ITERATIONS}.",
    ),
    click.option(
        "--scale",
        type=Number(min=0, min_open=True),
        default=1.0,
        help="Multiply the default iterations by this instead.",
    ),
    click.option(
        "--train",
        type=click.Choice(["opacity", "appearance", "all"]),
        default="all",
        show_default=True,
        help="Parameters that move in every arm.",
    ),
    click.option(
        "--seeds",
        default="0",
        show_default=True,
        metavar="N,N,...",
        callback=_seeds,
        help="Train every arm once for each of these seeds.",
    ),
    engine_options(),
)

_TRAINING = """{asks}

Trains MODEL in several ways and compares them on held-out views, with controls of equal length.
Frames are timed at the photographs' size and with sides four times as long.

\b
Example:
  python -m lab {name} point_cloud.ply --data scene --out experiments --seeds 0,1,2
"""


def _train(
    name: str,
    model: Path,
    scene: SceneOptions,
    out: Path,
    iters: int | None,
    scale: float,
    train: Any,
    seeds: tuple[int, ...],
    engine: EngineOptions,
) -> Report:
    """Run an experiment that compares trainings."""
    longest = iters or max(1, round(FINETUNE_ITERATIONS * scale))
    experiment = EXPERIMENTS[name](Settings(iterations=longest, train=train))

    from lab import results, running

    rasterizer, where = open_engine(engine)
    photographs = photographs_for(model, scene)
    with sigterm_interrupts():
        folder, outcomes = running.run(
            experiment, model, photographs, out, engine=rasterizer, device=where, seeds=seeds
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
    _asks = _make(Settings()).asks
    command.command(
        _name,
        cls=Command,
        rules=[Alone(("--iters", "--scale"))],
        short_help=_asks,
        help=_TRAINING.format(asks=_asks, name=_name),
    )(_training_options(partial(_train, _name)))


_views_options = bundled(
    _as_given,
    click.argument("models", metavar="MODEL...", type=MODEL, nargs=-1, required=True),
    scene_options(),
    _out_option,
    engine_options(),
)


@command.command("stages", cls=Command, short_help=QUESTIONS["stages"])
@_views_options
@click.option(
    "--repeats", type=click.IntRange(min=2), default=15, show_default=True, help="Timed rounds."
)
def _time_stages(
    models: tuple[Path, ...], scene: SceneOptions, out: Path, engine: EngineOptions, repeats: int
) -> Report:
    """Time the stages of frames on held-out views, from 256 pixels to 4K.

    Every MODEL is drawn with the thresholds stored beside it, all of them in turns. One MODEL alone
    is drawn without its thresholds too. Use an idle machine.

    \b
    Example:
      python -m lab stages point_cloud.ply pruned.ply --data scene --out experiments
    """
    from lab import stages

    drawer, where = open_engine(engine)
    photographs = photographs_for(models[0], scene)
    return _report(
        stages.run(models, photographs, out, engine=drawer, device=where, repeats=repeats)
    )


@command.command("fragments", cls=Command, short_help=QUESTIONS["fragments"])
@_views_options
def _count_fragments(
    models: tuple[Path, ...], scene: SceneOptions, out: Path, engine: EngineOptions
) -> Report:
    """Count fragments by Gaussian, opacity, size and weight on held-out views.

    Every MODEL is drawn with the thresholds stored beside it. One MODEL alone is drawn without its
    thresholds too.

    \b
    Example:
      python -m lab fragments point_cloud.ply pruned.ply --data scene --out experiments
    """
    from lab import fragments

    drawer, where = open_engine(engine)
    photographs = photographs_for(models[0], scene)
    return _report(fragments.run(models, photographs, out, engine=drawer, device=where))
