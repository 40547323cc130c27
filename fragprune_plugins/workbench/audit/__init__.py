"""``fragprune audit``: what a splat costs to draw, and how much of it nobody sees."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fragprune_plugins.errors import UsageError
from fragprune_plugins.workbench.commands.common import (
    CAMERAS_HELP,
    FILE,
    MODEL,
    Command,
    Report,
    cameras_of,
    engine_options,
    open_engine,
    truncation_option,
)
from fragprune_plugins.workbench.models import model as models

if TYPE_CHECKING:
    from fragprune_plugins.workbench.audit.placing import Placed, Side

PAGE, FIGURES = "audit.html", "audit.json"

LARGEST = 1600
"""Pixels of a picture's longer side, as hosts have it: a frame of more takes long."""


@click.command("audit", cls=Command)
@click.argument("model", type=MODEL)
@click.option(
    "--cameras",
    type=FILE,
    help=f"{CAMERAS_HELP}, if there is one.",
)
@click.option("--data", type=FILE, help="Scene folder whose cameras look; no image is needed.")
@click.option("--orbit", "side", flag_value="orbit", help="Generate cameras all around it.")
@click.option("--inside", "side", flag_value="inside", help="Generate cameras inside of it.")
@click.option(
    "--views",
    type=click.IntRange(1, 1000),
    default=12,
    show_default=True,
    help="Cameras to generate, or to take evenly from the given ones, at most.",
)
@click.option("--out", type=FILE, required=True, help=f"Folder for {PAGE}, {FIGURES} and maps.")
@click.option(
    "--resolution",
    type=click.IntRange(1, 16),
    help=f"Divide the pictures' sides by this; default: until they have {LARGEST} pixels or less.",
)
@click.option("--white-background", is_flag=True, help="Draw over white, with given cameras.")
@truncation_option
@engine_options
def command(
    model: Path,
    cameras: Path | None,
    data: Path | None,
    side: Side | None,
    views: int,
    out: Path,
    resolution: int | None,
    white_background: bool,
    no_truncation: bool,
    engine: str,
    device: str,
    threads: int | None,
) -> Report:
    """Measure what MODEL costs to draw, and how much of that changes nothing. No photograph needed.

    It counts fragments and overdraw with maps, weighs single fragments, tries cuts that need no
    training, and says what viewers with other rules pay. The page is one file.

    Without given cameras, and without those of the training of MODEL, some are generated: from
    outside or from inside, whichever suits the model. The output says which, and why.

    Views and tiles are samples, so that the time is bounded: about a minute for 125,000 Gaussians
    on two cores, some minutes for a million.

    \b
    Examples:
      fragprune audit statue.ply --out audit
      fragprune audit point_cloud.ply --cameras cameras.json --out audit
    """
    from fragprune_plugins.files.atomic import replacing, writable_folder
    from fragprune_plugins.files.records import strict
    from fragprune_plugins.workbench.audit import page as audit_page
    from fragprune_plugins.workbench.audit.audit import audit
    from fragprune_plugins.workbench.figures.wording import nothing_drawn

    if sum(each is not None for each in (cameras, data, side)) > 1:
        raise UsageError(
            "options",
            "more than one of --cameras, --data, --orbit and --inside",
            "one of them at most",
            "Pass one, or none.",
        )
    rasterizer, where = open_engine(engine, device, threads)
    writable_folder(out)
    loaded = models.load(model, truncation=not no_truncation, device=where)
    if cameras is None and data is None and side is None:
        cameras = cameras_of(model)
    if cameras is None and data is None:
        from fragprune_plugins.workbench.audit.placing import place

        placed = place(loaded, views, rasterizer, side=side or "auto", divide=resolution or 1)
    else:
        placed = _given(cameras, data, views, resolution, white_background)
    named = [(name, view.to(where)) for name, view in placed.views]
    figures, shown = audit(loaded, named, engine=rasterizer, progress=True)
    enclosed = None if math.isnan(placed.enclosed) else placed.enclosed
    figures = {
        "model": str(model),
        "cameras": {"kind": placed.side, "why": placed.why, "enclosed": enclosed},
        **figures,
        "maps": audit_page.draw(out, shown),
    }
    figures["result"] = audit_page.sentence(figures)
    figures["pruning"] = audit_page.pruning(figures)
    figures["warnings"] = nothing_drawn([figures["fragments_per_pixel"]])
    with replacing(out / FIGURES) as path:
        path.write_text(json.dumps(strict(figures), indent=1) + "\n", encoding="utf-8")
    with replacing(out / PAGE) as path:
        path.write_text(audit_page.compose(figures, out), encoding="utf-8")
    lines = [
        audit_page.text(figures),
        *(f"Warning: {each}" for each in figures["warnings"]),
        f"Wrote {out / PAGE} and {FIGURES}.",
    ]
    return Report(figures | {"page": str(out / PAGE)}, "\n".join(lines))


def _given(
    cameras: Path | None, data: Path | None, count: int, divide: int | None, white_background: bool
) -> Placed:
    """Cameras of a file or a scene folder, so many at most, evenly spread."""
    from fragprune_plugins.learning.stage2 import evenly
    from fragprune_plugins.workbench.audit.placing import Placed
    from fragprune_plugins.workbench.scenes.cameras import divided, load_cameras, load_scene_cameras

    if cameras is not None:
        named = load_cameras(cameras, white_background=white_background)
    else:
        assert data is not None
        train, test = load_scene_cameras(data, white_background=white_background)
        named = sorted([*train, *test], key=lambda each: each[0])
    every = len(named)
    chosen = list(evenly(named, count))
    longest = max(max(view.width, view.height) for _, view in chosen)
    chosen = divided(chosen, divide or -(-longest // LARGEST))
    why = f"{len(chosen)} of the {every} cameras of {cameras or data}, evenly spread."
    return Placed(chosen, "given", why, math.nan)
