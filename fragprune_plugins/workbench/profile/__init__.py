"""``fragprune profile``: measures the quality, fragments and frame time of a splat."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fragprune_plugins.workbench.commands.common import (
    FILE,
    MODEL,
    Command,
    Report,
    data_options,
    engine_options,
    load_shots,
    open_engine,
    photographs_for,
    truncation_option,
    views_option,
)
from fragprune_plugins.workbench.models import model as models

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fragprune_plugins.engines import Engine
    from fragprune_plugins.workbench.figures.evaluate import Candidate
    from fragprune_plugins.workbench.scenes.dataset import Shot

PANELS = 4


@click.command("profile", cls=Command)
@click.argument("model", type=MODEL)
@data_options
@click.option("--out", type=FILE, help="Folder for pictures: photograph, render, fragment density.")
@views_option
@truncation_option
@engine_options
def command(
    model: Path,
    data: Path | None,
    images: str,
    resolution: int,
    white_background: bool,
    out: Path | None,
    views: str,
    no_truncation: bool,
    engine: str,
    device: str,
    threads: int | None,
) -> Report:
    """Measure MODEL: quality, fragments per pixel, time per frame.

    A model with thresholds is measured with and without them, on the same frames in turns.

    \b
    Examples:
      fragprune profile pruned.ply --data scene --out pictures
      fragprune profile out                          (the output folder of a training)
    """
    import torch

    from fragprune_plugins.files import records
    from fragprune_plugins.files.atomic import writable_folder
    from fragprune_plugins.workbench.figures.evaluate import Candidate, measure_all
    from fragprune_plugins.workbench.figures.wording import describe, nothing_drawn

    rasterizer, where = open_engine(engine, device, threads)
    if out is not None:
        writable_folder(out)
    loaded = models.load(model, truncation=not no_truncation, device=where)
    photographs = photographs_for(model, data, images, resolution, white_background)
    shots = load_shots(photographs, views, where)
    columns = {"untruncated": Candidate(loaded.untruncated())}
    if loaded.falloff is not None:
        columns["truncated"] = Candidate(loaded)
    measured = dict(
        zip(columns, measure_all(list(columns.values()), shots, engine=rasterizer), strict=True)
    )
    last = list(measured)[-1]
    report: dict[str, Any] = {"model": str(model), "truncated": loaded.falloff is not None}
    report |= measured[last] | {"columns": measured}
    warnings = nothing_drawn([each["fragments_per_pixel"] for each in measured.values()])
    report["warnings"] = warnings
    lines = [describe(measured), *(f"Warning: {each}" for each in warnings)]
    if loaded.falloff is not None:
        points = torch.tensor([0.05, 0.25, 0.5, 0.75, 0.95])
        thresholds = loaded.falloff.cpu()
        step = max(1, len(thresholds) // 100_000)
        quantiles = torch.quantile(thresholds[::step], points).tolist()
        report["threshold_quantiles"] = quantiles
        lines.append(
            "learned thresholds (5, 25, 50, 75, 95 %): "
            + ", ".join(f"{value:.3f}" for value in quantiles)
        )
    if out is not None:
        files = draw_panels(out, columns, shots, rasterizer)
        report["files"] = [str(file) for file in files]
        records.leave(out / "profile", "profile", report)
        lines.append(f"Wrote {len(files)} pictures to {out}.")
    return Report(report, "\n".join(lines))


def draw_panels(
    out: Path, columns: dict[str, Candidate], shots: Sequence[Shot], engine: Engine
) -> list[Path]:
    """Draw evenly spread views: photograph, renders, and fragment densities on one scale.

    Args:
        out: folder for the PNGs.
        columns: candidates by name.
        shots: the views; ``PANELS`` of them at most are drawn.
        engine: draws the views.

    Returns:
        The files, one for each drawn view.
    """
    import torch

    from fragprune_plugins.learning.stage2 import evenly
    from fragprune_plugins.workbench.figures.pictures import save_panel, stems

    files = []
    drawn = {name: candidate.model.splats() for name, candidate in columns.items()}
    chosen = evenly(shots, PANELS)
    for stem, shot in zip(stems([shot.name for shot in chosen]), chosen, strict=True):
        with torch.no_grad():
            outputs = {
                name: candidate.draw(engine, shot.view, drawn[name], counts=True)
                for name, candidate in columns.items()
            }
        heat = {
            name: output.fragments
            for name, output in outputs.items()
            if output.fragments is not None
        }
        file = out / f"{stem}_panel.png"
        save_panel(
            file,
            [
                ("photograph", shot.image),
                *((name, output.image) for name, output in outputs.items()),
                *((f"{name}: {float(c.float().mean()):.1f}/px", c) for name, c in heat.items()),
            ],
            max(float(fragments.max()) for fragments in heat.values()),
        )
        files.append(file)
    return files
