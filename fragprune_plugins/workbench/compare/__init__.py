"""``fragprune compare``: measures two splats on the same photographs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from fragprune_plugins.errors import UsageError
from fragprune_plugins.workbench.commands.common import (
    DATA_HELP,
    FILE,
    MODEL,
    Command,
    Report,
    engine_options,
    image_options,
    load_shots,
    open_engine,
    truncation_option,
    views_option,
)
from fragprune_plugins.workbench.models import model as models

if TYPE_CHECKING:
    from fragprune_plugins.hosts.photographs import Photographs
    from fragprune_plugins.workbench.figures.recorded import Recorded


@click.command("compare", cls=Command)
@click.argument("a", type=MODEL)
@click.argument("b", type=MODEL)
@click.option(
    "--data",
    type=FILE,
    help=f"{DATA_HELP} Default: that of the training, run or fine-tuning that wrote the models.",
)
@image_options
@click.option("--out", type=FILE, help="Folder for side-by-side pictures.")
@views_option
@truncation_option
@click.option(
    "--enlarge",
    type=click.IntRange(1, 16),
    default=1,
    show_default=True,
    help="Time frames this many times as wide and high as the photographs. All other figures are "
    "still those at the photographs' size.",
)
@engine_options
@click.pass_context
def command(
    ctx: click.Context,
    a: Path,
    b: Path,
    data: Path | None,
    images: str,
    resolution: int,
    white_background: bool,
    out: Path | None,
    views: str,
    no_truncation: bool,
    enlarge: int,
    engine: str,
    device: str,
    threads: int | None,
) -> Report:
    """Measure A and B on the same photographs.

    Each model is drawn with the thresholds stored beside it, and frames are timed in turns. If a
    run or a fine-tuning wrote one of the models, its record gives the photographs, their size and
    background, and how models are drawn. Options given here override the record.

    \b
    Examples:
      fragprune compare point_cloud.ply pruned.ply --data scene --out pictures
      fragprune compare out/point_cloud/iteration_{30000,35001}/point_cloud.ply
      fragprune compare point_cloud.ply pruned.ply --data scene --enlarge 4 --threads 1
    """
    from fragprune_plugins.files import records
    from fragprune_plugins.files.atomic import writable_folder
    from fragprune_plugins.hosts.photographs import Resolution
    from fragprune_plugins.workbench.figures.evaluate import Candidate, measure_all
    from fragprune_plugins.workbench.figures.wording import describe, gain, nothing_drawn, strangers
    from fragprune_plugins.workbench.profile import draw_panels

    rasterizer, where = open_engine(engine, device, threads)
    if out is not None:
        writable_folder(out)
    known = _records(a, b)
    scene = _scene(data, known, a, b)
    if ctx.get_parameter_source("resolution") is not ParameterSource.DEFAULT:
        scene = replace(scene, resolution=Resolution(resolution))
    if ctx.get_parameter_source("images") is not ParameterSource.DEFAULT:
        scene = replace(scene, images=images)
    scene = replace(scene, white_background=scene.white_background or white_background)
    columns = {}
    for label, path in (("A", a), ("B", b)):
        how = known.get(path)
        filtered, drawing = (how.filtered, how.drawing) if how else (False, {})
        model = models.load(path, truncation=not no_truncation, filtered=filtered, device=where)
        columns[label] = Candidate(model, drawing)
    shots = load_shots(scene, views, where)
    first, second = measure_all(list(columns.values()), shots, engine=rasterizer, enlarge=enlarge)
    report: dict[str, Any] = {
        "a": {"model": str(a)} | first,
        "b": {"model": str(b)} | second,
        "speedup": first["fragments_per_pixel"] / max(second["fragments_per_pixel"], 1e-9),
        "psnr_change": second["psnr"] - first["psnr"],
        "ssim_change": second["ssim"] - first["ssim"],
        "engine": rasterizer.name,
        "device": first["device"],
        "enlarge": enlarge,
        "scene": scene.as_dict(),
        "warnings": nothing_drawn([each["fragments_per_pixel"] for each in (first, second)])
        + strangers(first, second),
    }
    width, height = shots[0].view.width, shots[0].view.height
    lines = [
        f"A: {a}\nB: {b}\nPhotographs: {scene.folder}, the first of {width}x{height} pixels\n",
        describe({"A": first, "B": second}),
        *([f"Frames of {enlarge * width}x{enlarge * height} pixels."] if enlarge > 1 else []),
        f"\nB against A: {gain(first, second)}.",
        *(f"Warning: {each}" for each in report["warnings"]),
    ]
    if out is not None:
        files = draw_panels(out, columns, shots, rasterizer)
        report["files"] = [str(file) for file in files]
        records.leave(out / "compare", "compare", report)
        lines.append(f"Wrote {len(files)} pictures to {out}.")
    return Report(report, "\n".join(lines))


def _records(*models: Path) -> dict[Path, Recorded]:
    """By model, what the record of the command that wrote it says, if there is one."""
    from fragprune_plugins.files import records
    from fragprune_plugins.workbench.figures.recorded import recorded

    known: dict[Path, Recorded] = {}
    for model in models:
        record = records.beside(model)
        read = recorded(record) if record else None
        if read:
            known[model] = read
            known |= {other: read for other in models if other.resolve() == read.models[0]}
    return known


def _scene(data: Path | None, known: dict[Path, Recorded], *models: Path) -> Photographs:
    """The photographs to measure on, in the folder ``data`` if given.

    Those of the records; without records, those that the models were trained on.

    Raises:
        UsageError: there is no folder, and nothing says which, or the models differ in it.
        DatasetError: a training's arguments cannot be read.
    """
    from fragprune_plugins.hosts.photographs import Photographs
    from fragprune_plugins.workbench.scenes.output import trained_on

    read = {each.photographs for each in known.values()}
    if not read and data is None:
        read = {each for each in map(trained_on, models) if each is not None}
    if len(read) == 1:
        (scene,) = read
        return scene if data is None else replace(scene, folder=data)
    if data is None:
        raise UsageError(
            "--data",
            "no folder, and the models' runs read photographs in two ways"
            if read
            else "no folder, and no record of a run or cfg_args of a training beside the models",
            "a scene folder",
            "Name it with --data.",
        )
    return Photographs(data)
