"""``fragprune export``: writes a PLY with a column of thresholds, for other tools."""

from __future__ import annotations

from pathlib import Path

import click

from fragprune_plugins.cli.common import (
    MODEL,
    Command,
    OutFile,
    Report,
    describe_dropped,
    dropping,
    require_place,
)
from fragprune_plugins.errors import SidecarError
from fragprune_plugins.storage import models


@click.command("export", cls=Command)
@click.argument("model", type=MODEL)
@click.option("--out", type=OutFile(".ply"), required=True, help="PLY to write.")
@click.option(
    "--drop-invisible",
    "drop",
    is_flag=True,
    help="Leave out Gaussians that no view can draw, with an opacity below 1/255.",
)
def command(model: Path, out: Path, drop: bool) -> Report:
    """Write MODEL with a further column for its thresholds.

    The column trunc_threshold holds the threshold, a falloff in (0, 1). A renderer gets the same
    picture as fragprune if it draws a fragment only where exp(-q/2) >= trunc_threshold, with q the
    squared Mahalanobis distance. Tools that read columns by name ignore a column that they do not
    know.

    \b
    Example:
      fragprune export pruned.ply --out for_viewer.ply
    """
    from fragprune_plugins.measure.visibility import visible
    from fragprune_plugins.storage import sidecar
    from fragprune_plugins.storage.atomic import staging
    from fragprune_plugins.storage.ply import THRESHOLD_COLUMN, write_ply

    require_place(out, model)
    splat, store = models.load(model)
    if store is None:
        raise SidecarError(
            str(sidecar.path_beside(model)),
            "no thresholds for this model",
            "a sidecar beside it, written by fragprune",
            "Run fragprune finetune first.",
        )
    thresholds = splat.thresholds  # a column keeps its bits
    if thresholds is None or sidecar.find(model):
        thresholds = store.values.detach()
    dropped, lines, count = None, [], len(splat)
    with staging(out) as folder:
        new = folder / out.name
        write_ply(new, splat, thresholds)
        size = new.stat().st_size
        if drop:
            kept = visible(splat, thresholds)
            splat = splat.keep(kept)
            write_ply(new, splat, thresholds[kept])
        sidecar.replace_pair(out, new, None)  # removes that of an earlier model under this name
    if drop:
        dropped = dropping(out, size, count, len(splat))
        lines.append(describe_dropped(dropped, "too faint for any view"))
    lines.append(f"Wrote {out}: {len(splat)} Gaussians with {THRESHOLD_COLUMN}.")
    return Report(
        {
            "model": str(model),
            "out": str(out),
            "gaussians": len(splat),
            "column": THRESHOLD_COLUMN,
            "dropped": dropped,
        },
        "\n".join(lines),
    )
