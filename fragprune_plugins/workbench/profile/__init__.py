"""``fragprune profile``: measures the quality, fragments and frame time of a splat."""

from __future__ import annotations

from typing import Any

import click

from fragprune_plugins.workbench.commands.command import Command, Report, work_of
from fragprune_plugins.workbench.commands.options import (
    CAMERAS_APART,
    FILE,
    MODEL,
    engine_options,
    own_picture_options,
    scene_options,
    truncation_option,
    views_option,
)


@click.command("profile", cls=Command, rules=[CAMERAS_APART])
@click.argument("model", type=MODEL)
@scene_options()
@own_picture_options
@click.option("--out", type=FILE, help="Folder for pictures: photograph, render, fragment density.")
@views_option
@truncation_option
@engine_options()
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
