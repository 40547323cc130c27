"""``fragprune view``: a model in the browser, original beside pruned."""

from __future__ import annotations

from typing import Any

import click

from fragprune_plugins.workbench.commands.command import Command, Report, work_of
from fragprune_plugins.workbench.commands.options import CAMERAS_APART, CAMERAS_HELP, FILE, MODEL


@click.command("view", cls=Command, rules=[CAMERAS_APART])
@click.argument("model", type=MODEL)
@click.argument("other", type=MODEL, required=False)
@click.option(
    "--data", type=FILE, help="Scene folder: its held-out cameras, with their photographs."
)
@click.option("--cameras", type=FILE, help=f"{CAMERAS_HELP}, if there is one.")
@click.option(
    "--out",
    type=FILE,
    help="Write the viewer into this folder instead of serving it, or into one .html file.",
)
@click.option("--white-background", is_flag=True, help="Show the model over white.")
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=0,
    show_default="any free one",
    help="Port to serve at, on 127.0.0.1.",
)
@click.option("--no-browser", is_flag=True, help="Open no browser; print the address only.")
def command(**options: Any) -> Report:
    """Look at MODEL in the browser, with fragments, overdraw and frame times.

    A model with cutoffs is shown right of a split. Left of it is OTHER, or the original, if a
    record beside MODEL names it and it lies in the same folder; else MODEL without cutoffs.
    The page needs WebGL2 and no network: it is served to this machine only, until Ctrl-C. With
    --out it is a folder that any web server can serve, or one HTML file that a browser opens from
    disk.

    \b
    Examples:
      fragprune view pruned.ply
      fragprune view pruned.ply point_cloud.ply --data scene
      fragprune view pruned.ply --out page.html
      fragprune view out                                (the output folder of a training)
    """
    return work_of(__name__, **options)
