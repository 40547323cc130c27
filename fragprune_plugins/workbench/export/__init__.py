"""``fragprune export``: writes a model with its thresholds into one file, of any format."""

from __future__ import annotations

from pathlib import Path

import click

from fragprune_plugins.constants import TRANSMITTANCE_MIN
from fragprune_plugins.errors import SidecarError
from fragprune_plugins.workbench.commands.common import (
    MODEL,
    Command,
    Number,
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
@click.option(
    "--stop",
    type=Number(TRANSMITTANCE_MIN, 1),
    metavar="SHARE",
    help="Give the model a stop, also one that was never fine-tuned: a pixel draws the fragment "
    "that leaves less than this share of its light, and ends there. 0.01 is usual.",
)
@truncation_option
def command(model: Path, out: Path, drop: bool, stop: float | None, no_truncation: bool) -> Report:
    """Write MODEL with its thresholds and its stop into one file.

    A .ply gets a further column, trunc_threshold: a falloff in (0, 1). A renderer gets the same
    picture as fragprune if it draws a fragment only where exp(-q/2) >= trunc_threshold, with q the
    squared Mahalanobis distance. Tools that read columns by name ignore a column that they do not
    know. A stop is a comment of the header. .spz, .sog and .glb hold both as extensions, which
    other readers skip.

    .splat and .compressed.ply cannot hold thresholds: they are written with --no-truncation only.
    What a format does not keep is said when it is written.

    \b
    Examples:
      fragprune export pruned.ply --out for_viewer.ply
      fragprune export pruned.ply --out pruned.spz
      fragprune export model.spz --out model.ply --no-truncation
      fragprune export model.ply --out faster.ply --stop 0.01
    """
    from fragprune_plugins.files import sidecar
    from fragprune_plugins.files.atomic import put, staging
    from fragprune_plugins.files.ply import THRESHOLD_COLUMN
    from fragprune_plugins.workbench.pruning.visibility import visible

    form = formats.named(out)
    require_place(out, model, thresholds=not no_truncation or stop is not None)
    splat = models.load(model, truncation=not no_truncation)
    splat = splat if stop is None else splat.with_stop(stop)
    if not no_truncation and not splat.pruned:
        raise SidecarError(
            str(sidecar.path_beside(model)),
            "no thresholds for this model",
            "a sidecar beside it, written by fragprune, or a file that holds them",
            "Run fragprune finetune first, or add --stop; --no-truncation writes a model without "
            "thresholds.",
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
    cut = splat.falloff is not None
    column = THRESHOLD_COLUMN if form.paired and cut else None
    held = column or ("thresholds" if cut else "no thresholds")
    held += "" if splat.stop is None else f" and a stop at {splat.stop:g}"
    lines.append(describe_written(out, f": {len(splat)} Gaussians with {held}"))
    return Report(
        {
            "model": str(model),
            "out": str(out),
            "format": form.name,
            "keeps": form.keeps or None,
            "gaussians": len(splat),
            "thresholds": cut,
            "stop": splat.stop,
            "column": column,
            "dropped": dropped,
        },
        "\n".join(lines),
    )
