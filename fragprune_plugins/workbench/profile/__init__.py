"""``fragprune profile``: measures the quality, fragments and frame time of a splat."""

from __future__ import annotations

from typing import Any

import click

from fragprune_plugins.workbench.commands import options as shared
from fragprune_plugins.workbench.commands.command import Command, Report, work_of


@click.command("profile", cls=Command, rules=[shared.CAMERAS_APART])
@click.argument("model", type=shared.MODEL)
@shared.scene_options()
@shared.own_picture_options
@click.option(
    "--out", type=shared.FILE, help="Folder for pictures: photograph, render, fragment density."
)
@shared.views_option
@shared.truncation_option
@shared.engine_options()
def command(**options: Any) -> Report:
    """Measure MODEL: quality, fragments per pixel, time per frame.

    A model with cutoffs is measured with and without them, on the same frames in turns.

    Without photographs it is measured against its own pictures: --self, --cameras or --orbit. Then
    PSNR says what its cutoffs change.

    \b
    Examples:
      fragprune profile pruned.ply --data scene --out pictures
      fragprune profile out                          (the output folder of a training)
      fragprune profile pruned.ply --cameras cameras.json
    """
    return work_of(__name__, **options)
