"""``fragprune compare``: two splats on the same photographs."""

from __future__ import annotations

from pathlib import Path

import click

from fragprune_plugins.cli.common import (
    FILE,
    Command,
    Report,
    data_options,
    describe,
    engine_options,
    gain,
    load_shots,
    open_engine,
    truncation_option,
    views_option,
)
from fragprune_plugins.storage.models import load_model


@click.command("compare", cls=Command)
@click.argument("a", type=FILE)
@click.argument("b", type=FILE)
@data_options
@click.option("--out", type=FILE, help="Folder for side-by-side pictures.")
@views_option
@truncation_option
@engine_options
def command(
    a: Path,
    b: Path,
    data: Path,
    resolution: int,
    white_background: bool,
    out: Path | None,
    views: str,
    no_truncation: bool,
    engine: str,
    device: str,
    threads: int | None,
) -> Report:
    """Measure A and B on the same photographs.

    Each is drawn with the thresholds stored beside it; frames are timed in turns.

    \b
    Example:
      fragprune compare point_cloud.ply pruned.ply --data scene --out pictures
    """
    from fragprune_plugins.cli.profile import draw_panels
    from fragprune_plugins.measure import Candidate, measure
    from fragprune_plugins.storage import records
    from fragprune_plugins.storage.atomic import writable_folder

    rasterizer, where = open_engine(engine, device, threads)
    if out is not None:
        writable_folder(out)
    columns = {
        label: Candidate(*load_model(path, truncation=not no_truncation, device=where))
        for label, path in (("A", a), ("B", b))
    }
    shots = load_shots(
        data, views, resolution=resolution, white_background=white_background, device=where
    )
    first, second = measure(list(columns.values()), shots, engine=rasterizer)
    report = {
        "a": {"model": str(a)} | first,
        "b": {"model": str(b)} | second,
        "speedup": first["fragments_per_pixel"] / max(second["fragments_per_pixel"], 1e-9),
        "psnr_change": second["psnr"] - first["psnr"],
        "ssim_change": second["ssim"] - first["ssim"],
        "engine": rasterizer.name,
        "device": first["device"],
    }
    lines = [
        f"A: {a}\nB: {b}\n",
        describe({"A": first, "B": second}),
        f"\nB against A: {gain(first, second)}.",
    ]
    if out is not None:
        files = draw_panels(out, columns, shots, rasterizer)
        report["files"] = [str(file) for file in files]
        records.leave(out / "compare", "compare", report)
        lines.append(f"Wrote {len(files)} pictures to {out}.")
    return Report(report, "\n".join(lines))
