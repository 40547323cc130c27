"""``fragprune audit``: what a splat costs to draw, and how much of it nobody sees."""

from __future__ import annotations

from typing import Any

import click

from fragprune_plugins.workbench.commands import options as shared
from fragprune_plugins.workbench.commands.command import Command, Report, work_of


@click.command("audit", cls=Command, rules=[shared.CAMERAS_APART])
@click.argument("model", type=shared.MODEL)
@click.option("--cameras", type=shared.FILE, help=f"{shared.CAMERAS_HELP}, if there is one.")
@click.option(
    "--data", type=shared.FILE, help="Scene folder whose cameras look; no image is needed."
)
@click.option(
    "--orbit/--inside", default=None, help="Generate cameras all around it, or inside of it."
)
@click.option(
    "--views",
    type=click.IntRange(1, 1000),
    default=12,
    help="Cameras to generate, or to take evenly from the given ones, at most.",
)
@click.option("--out", type=shared.FILE, help="Folder for audit.html, audit.json and maps.")
@click.option(
    "--resolution",
    type=click.IntRange(1, 16),
    help="Divide the sides of pictures by this; default: as in the training of MODEL, and until "
    "they have 1,600 pixels or less.",
)
@click.option("--white-background", is_flag=True, help="Draw over white, with given cameras.")
@shared.truncation_option
@shared.engine_options()
def command(**options: Any) -> Report:
    """Measure what MODEL costs to draw, and how much of that changes nothing. No photograph needed.

    It counts fragments and overdraw with maps, weighs single fragments, tries cuts that need no
    training, and says what viewers with other rules pay. --out also writes a page, in one file.

    Without given cameras, and without those of the training of MODEL, some are generated: from
    outside or from inside, whichever suits the model. The output says which, and why.

    Views and tiles are samples, so that the time is bounded: less than a minute for 125,000
    Gaussians, about two minutes for a million.

    \b
    Examples:
      fragprune audit point_cloud.ply
      fragprune audit statue.ply --out audit
      fragprune audit point_cloud.ply --cameras cameras.json --out audit
    """
    return work_of(__name__, **options)
