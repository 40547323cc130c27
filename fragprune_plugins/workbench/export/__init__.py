"""``fragprune export``: writes a model with its cutoffs into one file, of any format."""

from __future__ import annotations

from typing import Any

import click

from fragprune_plugins.constants import TRANSMITTANCE_MIN
from fragprune_plugins.workbench.commands.command import Command, Report, work_of
from fragprune_plugins.workbench.commands.options import MODEL, Number, OutFile, truncation_option
from fragprune_plugins.workbench.commands.rules import Alone
from fragprune_plugins.workbench.models import formats


@click.command("export", cls=Command, rules=[Alone(("PRUNED", "--no-truncation"))])
@click.argument("model", type=MODEL)
@click.argument("pruned", type=MODEL, required=False)
@click.option(
    "--out",
    type=OutFile(*formats.ENDINGS),
    required=True,
    help="File to write; its suffix names the format: " + ", ".join(formats.SUFFIXES) + ".",
)
@click.option(
    "--keep",
    type=click.Choice(["visible"]),
    help="Leave out Gaussians that no view can draw, with an opacity below 1/255.",
)
@click.option(
    "--stop",
    type=Number(TRANSMITTANCE_MIN, 1),
    metavar="SHARE",
    help="Give the model a stop, also one that was never fine-tuned: a pixel draws the fragment "
    "that leaves less than this share of its light, and ends there. 0.02 is usual.",
)
@truncation_option
def command(**options: Any) -> Report:
    """Write MODEL with its cutoffs and its stop into one file.

    A .ply gets a further column, trunc_threshold: a falloff in (0, 1). A renderer gets the same
    picture as fragprune if it draws a fragment only where exp(-q/2) >= trunc_threshold, with q the
    squared Mahalanobis distance. Tools that read columns by name ignore a column that they do not
    know. A stop is a comment of the header. .spz, .sog and .glb hold both as extensions, which
    other readers skip.

    .splat and .compressed.ply cannot hold thresholds: --no-truncation leaves them out. The output
    says what a format does not keep.

    For a MODEL out of an editor that dropped cutoffs and stop, PRUNED gives them back. Gaussians
    are found by opacity and colour, in any order and place.

    \b
    Examples:
      fragprune export pruned.ply --out for_viewer.ply
      fragprune export pruned.ply --out pruned.spz
      fragprune export model.spz --out model.ply --no-truncation
      fragprune export model.ply --out faster.ply --stop 0.02
      fragprune export edited.ply pruned.ply --out again.ply
    """
    return work_of(__name__, **options)
