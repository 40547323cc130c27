"""``fragprune render``: draws pictures of a splat with its cutoffs."""

from __future__ import annotations

from typing import Any

import click

from fragprune_plugins.workbench.commands import options as shared
from fragprune_plugins.workbench.commands.command import (
    Command,
    Report,
    first_process_prints,
    work_of,
)
from fragprune_plugins.workbench.commands.rules import Needs, apart


def _direction(
    ctx: click.Context, param: click.Parameter, value: str
) -> tuple[float, float, float]:
    """Three numbers that are not all 0."""
    try:
        x, y, z = (float(part) for part in value.split(","))
    except ValueError as error:
        raise click.BadParameter(f"{value!r} is not a direction such as 0,-1,0.") from error
    if not 0 < x * x + y * y + z * z < float("inf"):
        raise click.BadParameter(f"{value!r} has no direction.")
    return x, y, z


_PHOTOGRAPHS = "a scene folder, which says what its images are and which are held out"

RULES = (
    shared.CAMERAS_APART,
    Needs("--images", ("--data",), _PHOTOGRAPHS),
    Needs("--views", ("--data",), _PHOTOGRAPHS),
    *apart("--out *.mp4", "--shard-gaussians", expected="a folder for --out"),
)


@click.command("render", cls=Command, rules=RULES)
@click.argument("model", type=shared.MODEL)
@click.option("--cameras", type=shared.FILE, help=f"{shared.CAMERAS_HELP}.")
@click.option(
    "--out",
    type=shared.FILE,
    required=True,
    help="Folder for the PNG files; or a film in .mp4, whose camera goes through the cameras in "
    "their order, in 8 seconds or a frame for each.",
)
@click.option("--orbit", is_flag=True, help="Go around MODEL instead, once; it suits an object.")
@click.option(
    "--up",
    default="0,-1,0",
    metavar="X,Y,Z",
    callback=_direction,
    help="With --orbit: up direction of the scene.",
)
@shared.views_option
@shared.scene_options("Scene folder whose cameras draw, instead of --cameras.")
@shared.truncation_option
@shared.shard_option
@shared.engine_options()
@first_process_prints()
def command(**options: Any) -> Report | None:
    """Render MODEL from many cameras, with one PNG for each camera, or as a film.

    The cutoffs beside MODEL apply, if there are any; --no-truncation ignores them. A film needs
    the extra [video].

    \b
    Examples:
      fragprune render pruned.ply --data scene --out renders
      fragprune render pruned.ply --cameras out/cameras.json --out renders
      fragprune render out --out renders                (the output folder of a training)
      fragprune render statue.ply --orbit --out statue.mp4
      fragprune render pruned.ply --cameras camera_path.json --out flight.mp4
    """
    return work_of(__name__, **options)
