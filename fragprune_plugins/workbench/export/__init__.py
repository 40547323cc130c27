"""``fragprune export``: writes a model with its thresholds into one file, of any format."""

from __future__ import annotations

from pathlib import Path

import click

from fragprune_plugins.errors import SidecarError
from fragprune_plugins.workbench.commands.common import (
    MODEL,
    Command,
    OutFile,
    Report,
    describe_dropped,
    describe_written,
    dropping,
    require_place,
    truncation_option,
)
from fragprune_plugins.workbench.models import formats
from fragprune_plugins.workbench.models import model as models


@click.command("export", cls=Command)
@click.argument("model", type=MODEL)
@click.option(
    "--out",
    type=OutFile(*formats.ENDINGS),
    required=True,
    help="File to write; its suffix names the format: " + ", ".join(formats.SUFFIXES) + ".",
)
@click.option(
    "--drop-invisible",
    "drop",
    is_flag=True,
    help="Leave out Gaussians that no view can draw, with an opacity below 1/255.",
)
@truncation_option
def command(model: Path, out: Path, drop: bool, no_truncation: bool) -> Report:
    """Write MODEL with its thresholds into one file.

    A .ply gets a further column, trunc_threshold: a falloff in (0, 1). A renderer gets the same
    picture as fragprune if it draws a fragment only where exp(-q/2) >= trunc_threshold, with q the
    squared Mahalanobis distance. Tools that read columns by name ignore a column that they do not
    know. .spz, .sog and .glb hold thresholds as extensions, which other readers skip.

    .splat and .compressed.ply cannot hold thresholds: they are written with --no-truncation only.
    What a format does not keep is said when it is written.

    \b
    Examples:
      fragprune export pruned.ply --out for_viewer.ply
      fragprune export pruned.ply --out pruned.spz
      fragprune export model.spz --out model.ply --no-truncation
    """
    from fragprune_plugins.files import sidecar
    from fragprune_plugins.files.atomic import put, staging
    from fragprune_plugins.files.ply import THRESHOLD_COLUMN
    from fragprune_plugins.workbench.pruning.visibility import visible

    form = formats.named(out)
    require_place(out, model, thresholds=not no_truncation)
    splat = models.load(model, truncation=not no_truncation)
    if not no_truncation and splat.thresholds is None:
        raise SidecarError(
            str(sidecar.path_beside(model)),
            "no thresholds for this model",
            "a sidecar beside it, written by fragprune, or a file that holds them",
            "Run fragprune finetune first; --no-truncation writes a model without thresholds.",
        )
    dropped, lines, count = None, [], len(splat)
    with staging(out) as folder:
        new = folder / out.name
        formats.write(form, new, splat)
        size = new.stat().st_size
        if drop:
            splat = splat.keep(visible(splat))
            formats.write(form, new, splat)
        if form.paired:  # removes the sidecar of an earlier model under this name
            sidecar.replace_pair(out, new, None)
        else:
            put(new, out)
    if drop:
        dropped = dropping(out, size, count, len(splat))
        lines.append(describe_dropped(dropped, "too faint for any view"))
    held = "no thresholds" if no_truncation else "thresholds"
    column = THRESHOLD_COLUMN if form.paired and not no_truncation else None
    lines.append(describe_written(out, f": {len(splat)} Gaussians with {column or held}"))
    return Report(
        {
            "model": str(model),
            "out": str(out),
            "format": form.name,
            "keeps": form.keeps or None,
            "gaussians": len(splat),
            "thresholds": not no_truncation,
            "column": column,
            "dropped": dropped,
        },
        "\n".join(lines),
    )
