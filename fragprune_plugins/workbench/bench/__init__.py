"""``fragprune bench``: times an engine on this machine, with and without truncation."""

from __future__ import annotations

import re
from typing import Any

import click

from fragprune_plugins.workbench.commands.command import Command, Report, work_of
from fragprune_plugins.workbench.commands.options import FILE, MODEL, engine_options
from fragprune_plugins.workbench.commands.rules import Alone, Needs


def _size(word: str) -> tuple[int, int]:
    """Width and height of a word such as 640x480."""
    if not (found := re.fullmatch(r"(0*[1-9]\d*)x(0*[1-9]\d*)", word)):
        raise click.BadParameter(f"{word!r} is not WIDTHxHEIGHT, such as 640x480.")
    return int(found[1]), int(found[2])


RULES = (
    Alone(("--gaussians", "MODEL"), "options that have an effect"),
    Needs("--cameras", ("MODEL",), "a model to draw from them"),
)


@click.command("bench", cls=Command, rules=RULES)
@click.argument("model", type=MODEL, required=False)
@click.option("--cameras", type=FILE, help="With MODEL: file of cameras; the first one draws.")
@click.option(
    "--size",
    "sizes",
    multiple=True,
    default=("640x480", "1280x960"),
    type=_size,
    metavar="WIDTHxHEIGHT",
    help="Image size; may be given several times.",
)
@click.option(
    "--gaussians",
    multiple=True,
    type=click.IntRange(min=1),
    default=(100_000,),
    help="Number of Gaussians in the generated scene; may be given several times.",
)
@engine_options()
def command(**options: Any) -> Report:
    """Time rasterization, forward and with all gradients, with and without cutoffs.

    MODEL is drawn with its own cutoffs. Without MODEL a scene is generated, the same on every
    machine. All rows are timed in turns, so that a busy machine slows them alike. Close other
    programs anyway, and read the load below the table.

    \b
    Examples:
      fragprune bench
      fragprune bench --size 320x240 --size 3840x2160 --gaussians 10000 --gaussians 3000000
      fragprune bench point_cloud.ply --cameras cameras.json --size 1280x720
    """
    return work_of(__name__, **options)
