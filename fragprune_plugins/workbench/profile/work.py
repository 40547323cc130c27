"""Measures a model with and without its thresholds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fragprune_plugins.workbench.commands import command, opening, options
from fragprune_plugins.workbench.figures import evaluate, matching, pictures, wording
from fragprune_plugins.workbench.models.model import load, writable_folder
from fragprune_plugins.workbench.scenes.training import exposures_left_out


def profile(
    *,
    model: Path,
    itself: bool,
    orbit: bool,
    cameras: Path | None,
    scene: options.SceneOptions,
    out: Path | None,
    views: str,
    no_truncation: bool,
    engine: options.EngineOptions,
) -> command.Report:
    """Do what ``fragprune profile`` promises; its options are the arguments."""
    rasterizer, device = opening.open_engine(engine)
    if out is not None:
        writable_folder(out)
    filtered, drawing = opening.as_trained(model)
    loaded = load(model, truncation=not no_truncation, filtered=filtered, device=device)
    if itself:
        drawing = {}  # as its own pictures are drawn
        own = opening.own_cameras_for(model, scene, cameras, orbit=orbit)
        dataset = own.pictures(loaded.untruncated(), rasterizer)
    else:
        remedy = "Name the scene's folder with --data; without photographs, pass --self."
        read = opening.photographs_for(model, scene, remedy=remedy)
        _, dataset = matching.told_or_matched(loaded.untruncated(), read, rasterizer)
    shots = opening.chosen(dataset, views)
    columns = {"untruncated": evaluate.Candidate(loaded.untruncated(), drawing)}
    if loaded.pruned:
        columns["truncated"] = evaluate.Candidate(loaded, drawing)
    measurements = evaluate.measure_all(list(columns.values()), shots, engine=rasterizer)
    measured = dict(zip(columns, measurements, strict=True))
    warnings = [
        *wording.nothing_drawn([each["fragments_per_pixel"] for each in measurements]),
        *matching.hardly_shown({"MODEL": measurements[-1]["psnr"]}, shots),
        *([] if itself else exposures_left_out(model)),
    ]
    report: dict[str, Any] = {
        "model": str(model),
        "truncated": loaded.falloff is not None,
        **measurements[-1],
        "columns": measured,
        "warnings": warnings,
    }
    lines = [wording.describe(wording.profiled(report)), *(f"Warning: {each}" for each in warnings)]
    if loaded.falloff is not None:
        quantiles = np.quantile(loaded.falloff.cpu(), [0.05, 0.25, 0.5, 0.75, 0.95]).tolist()
        report["threshold_quantiles"] = quantiles
        lines.append(
            "Cutoffs as falloffs, 1 at a Gaussian's centre, 0 far outside (5, 25, 50, 75, 95 %): "
            + ", ".join(f"{value:.3f}" for value in quantiles)
        )
    if out is not None:
        named = dict(zip(wording.profiled(report), columns.values(), strict=True))
        lines.append(pictures.leave_panels(out, "profile", report, named, shots, rasterizer))
    return command.Report(report, "\n".join(lines))
