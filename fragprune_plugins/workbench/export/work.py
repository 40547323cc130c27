"""Writes a model into one file of any format."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from fragprune_plugins.errors import AlignmentError, ModelFileError
from fragprune_plugins.files.model import Model
from fragprune_plugins.files.ply import THRESHOLD_COLUMN
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.workbench.commands.command import Report
from fragprune_plugins.workbench.figures.metrics import psnr
from fragprune_plugins.workbench.figures.viewing import overview, rasterize
from fragprune_plugins.workbench.figures.wording import VISIBLE
from fragprune_plugins.workbench.models import formats
from fragprune_plugins.workbench.models.model import describe_written, load, require_place, save
from fragprune_plugins.workbench.pruning import visible


def export(
    *,
    model: Path,
    out: Path,
    keep: str | None,
    stop: float | None,
    pruned: Path | None,
    no_truncation: bool,
) -> Report:
    """Do what ``fragprune export`` promises; its options are the arguments."""
    form = formats.named(out)
    for given in filter(None, (model, pruned)):
        require_place(out, given, thresholds=stop is not None or pruned is not None)
    splat = load(model, truncation=not no_truncation)
    if pruned is not None:
        splat = _restored(splat, model, pruned)
    if stop is not None:
        splat = splat.with_rules(stop=stop)
    if splat.pruned:
        formats.expect_carrier(form, out)
    dropped, lines, count = None, [], len(splat)
    if keep == "visible":
        splat = splat.keep(visible(splat))
        gone = count - len(splat)
        dropped = {"gaussians": gone, "of": count}
        lines.append(f"Dropped {gone:,} of {count:,} Gaussians, too faint for any view.")
    save(out, splat)
    truncated = splat.falloff is not None
    column = THRESHOLD_COLUMN if form.paired and truncated else None
    lines.append(describe_written(out, _held(splat, column), pruned=splat.pruned))
    kept = None
    if form.keeps:
        view = overview(splat, width=480, height=360)  # from outside
        with torch.no_grad():
            kept = psnr(*(rasterize(each, view).image for each in (load(out), splat)))
        lines.append(_said(kept))
    data = {
        "model": str(model),
        "out": str(out),
        "format": form.name,
        "keeps": form.keeps or None,
        "psnr": kept,
        "gaussians": len(splat),
        "thresholds": truncated,
        **splat.rules,
        "column": column,
        "dropped": dropped,
    }
    return Report(data, "\n".join(lines))


def _held(splat: Model, column: str | None) -> str:
    """What a file holds: Gaussians, cutoffs, the rules."""
    held = "no cutoffs" if splat.falloff is None else "cutoffs"
    held += f" in the column {column}" if column else ""
    held += "" if splat.rim == "hard" else f" and a {splat.rim} rim"
    held += "" if splat.stop is None else f" and a stop at {splat.stop:g}"
    return f": {len(splat)} Gaussian{'' if len(splat) == 1 else 's'} with {held}"


def _said(kept: float) -> str:
    """A sentence on the picture that a format keeps."""
    found = "equal to" if kept == torch.inf else f"at {kept:.1f} dB PSNR against"
    said = f"From outside, the file's picture is {found} the model's."
    if kept >= VISIBLE:
        return said
    return (
        f"{said} Warning: below {VISIBLE:g} dB the change can be seen. Choose another format; a "
        "Gaussian far from all others, or a scene of very small or large units, takes its bits."
    )


def _restored(edited: Model, path: Path, source: Path) -> Model:
    """A model with the cutoffs and rules of another, in which its Gaussians are found again."""
    # By opacity and first colour: editors that reorder, remove, move, turn and enlarge Gaussians
    # keep both to the bit. Of Gaussians that look alike the smallest cutoff serves.
    pruned = load(source)
    if pruned.falloff is None:
        found, remedy = "a model without cutoffs", "Name the pruned one."
        raise ModelFileError(str(source), found, "a pruned model", remedy)
    looks = [torch.cat([each.opacity, each.f_dc[:, 0]], dim=1) for each in (pruned, edited)]
    kinds, of = torch.unique(torch.cat(looks), dim=0, return_inverse=True)
    theirs, ours = of.split([len(pruned), len(edited)])
    least = torch.full((len(kinds),), torch.inf)
    again = least.scatter_reduce(0, theirs, pruned.falloff, "amin")[ours]
    if strange := int(again.isinf().sum()):
        found = f"{strange:,} of {len(edited):,} Gaussians that {source} lacks"
        expected = "opacities and colours as they are there, to the bit"
        alone = "Leave colours alone and save a .ply"
        remedy = f"{alone}, or prune the edited model: fragprune finetune."
        raise AlignmentError(str(path), found, expected, remedy)
    return replace(edited, thresholds=ThresholdStore.from_falloff(again).ruled(**pruned.rules))
