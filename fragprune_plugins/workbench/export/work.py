"""Writes a model into one file of any format."""

from __future__ import annotations

from pathlib import Path

from fragprune_plugins.files.ply import THRESHOLD_COLUMN
from fragprune_plugins.workbench.commands.command import Report
from fragprune_plugins.workbench.models import formats
from fragprune_plugins.workbench.models.model import load, save
from fragprune_plugins.workbench.models.written import (
    describe_dropped,
    describe_written,
    dropping,
    require_place,
)
from fragprune_plugins.workbench.pruning.visibility import visible


def export(
    *, model: Path, out: Path, drop: bool, stop: float | None, no_truncation: bool
) -> Report:
    """Do what ``fragprune export`` promises; its options are the arguments."""
    form = formats.named(out)
    require_place(out, model, thresholds=stop is not None)
    splat = load(model, truncation=not no_truncation)
    splat = splat if stop is None else splat.with_stop(stop)
    if splat.pruned:
        formats.expect_carrier(form, out)
    dropped, lines, count = None, [], len(splat)
    save(out, splat)
    if drop:
        size, splat = out.stat().st_size, splat.keep(visible(splat))
        save(out, splat)
        dropped = dropping(out, size, count, len(splat))
        lines.append(describe_dropped(dropped, "too faint for any view"))
    truncated = splat.falloff is not None
    column = THRESHOLD_COLUMN if form.paired and truncated else None
    held = "cutoffs" if truncated else "no cutoffs"
    held += f" in the column {column}" if column else ""
    held += "" if splat.rim == "hard" else f" and a {splat.rim} rim"
    held += "" if splat.stop is None else f" and a stop at {splat.stop:g}"
    lines.append(
        describe_written(out, f": {len(splat)} Gaussians with {held}", pruned=splat.pruned)
    )
    return Report(
        {
            "model": str(model),
            "out": str(out),
            "format": form.name,
            "keeps": form.keeps or None,
            "gaussians": len(splat),
            "thresholds": truncated,
            **splat.rules,
            "column": column,
            "dropped": dropped,
        },
        "\n".join(lines),
    )
