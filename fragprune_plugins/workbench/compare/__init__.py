"""``fragprune compare``: measures two splats on the same pictures."""

from __future__ import annotations

from typing import Any

import click

from fragprune_plugins.workbench.commands import options as shared
from fragprune_plugins.workbench.commands.command import Command, Report, work_of


@click.command("compare", cls=Command, rules=[shared.CAMERAS_APART])
@click.argument("a", type=shared.MODEL)
@click.argument("b", type=shared.MODEL)
@shared.scene_options(
    f"{shared.DATA_HELP} Default: that of the training, run or fine-tuning that wrote the models."
)
@shared.own_picture_options
@click.option("--out", type=shared.FILE, help="Folder for side-by-side pictures.")
@shared.views_option
@shared.truncation_option
@click.option(
    "--enlarge",
    type=click.IntRange(1, 16),
    default=1,
    help="Time frames this many times as wide and high as the photographs. All other figures are "
    "still those at the photographs' size.",
)
@shared.engine_options()
def command(**options: Any) -> Report:
    """Measure A and B on the same photographs, or against A's own pictures.

    Each model is drawn with its cutoffs, and frames are timed in turns. If a
    run or a fine-tuning wrote one of the models, its record gives the photographs, their size and
    background, and how models are drawn. Options given here override the record.

    Without photographs, --self, --cameras and --orbit compare B with A's own pictures. Models that
    fragprune finetune --self wrote are compared so, from the same cameras.

    \b
    Examples:
      fragprune compare point_cloud.ply pruned.ply --data scene --out pictures
      fragprune compare out/point_cloud/iteration_{30000,35001}/point_cloud.ply
      fragprune compare point_cloud.ply pruned.ply --data scene --enlarge 4 --threads 1
      fragprune compare statue.ply pruned.ply --orbit
    """
    return work_of(__name__, **options)
