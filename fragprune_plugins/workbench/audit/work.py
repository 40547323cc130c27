"""Measures a model from given or generated cameras, and writes the page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from fragprune_plugins.files.atomic import replacing
from fragprune_plugins.hosts.photographs import Resolution
from fragprune_plugins.learning.stage2 import evenly_spaced
from fragprune_plugins.workbench.audit import page, placing
from fragprune_plugins.workbench.audit.audit import audit as measured
from fragprune_plugins.workbench.commands import command, opening, options
from fragprune_plugins.workbench.figures import records, wording
from fragprune_plugins.workbench.models.model import load, writable_folder
from fragprune_plugins.workbench.scenes.cameras import load_cameras, load_scene_cameras, sized
from fragprune_plugins.workbench.scenes.output import cameras_of

PAGE, FIGURES = "audit.html", "audit.json"
LARGEST = 1600  # pixels of a picture's longer side, as hosts have it: a frame of more takes long


def audit(
    *,
    model: Path,
    cameras: Path | None,
    data: Path | None,
    orbit: bool | None,
    views: int,
    out: Path | None,
    resolution: int | None,
    white_background: bool,
    no_truncation: bool,
    engine: options.EngineOptions,
) -> command.Report:
    """Do what ``fragprune audit`` promises; its options are the arguments."""
    rasterizer, device = opening.open_engine(engine)
    loaded = load(model, truncation=not no_truncation, device=device)
    opening.warn_if_antialiased(model)
    if out is not None:
        writable_folder(out)
    given, size = frozenset({"resolution"} if resolution else ()), Resolution(resolution or 1)
    scene = options.SceneOptions(
        data, resolution=size, white_background=white_background, given=given
    )
    if cameras is None and data is None and orbit is None and (cameras := cameras_of(model)):
        scene = opening.at_its_size(model, scene)
    if cameras is None and data is None:
        side: placing.Side = "auto" if orbit is None else "orbit" if orbit else "inside"
        placed = placing.place(loaded, views, rasterizer, side=side, divide=resolution or 1)
    else:
        placed = _given(cameras, opening.over_its_background(model, scene), views)
    named = [(name, view.to(device)) for name, view in placed.views]
    measurements, shown = measured(loaded, named, engine=rasterizer, progress=True)
    figures: dict[str, Any] = {
        "model": str(model),
        "data": None if data is None else str(data),
        "cameras": {"kind": placed.side, "why": placed.why, "enclosed": placed.enclosed},
        **measurements,
        "maps": None if out is None else page.draw(out, shown),
    }
    figures["result"] = page.sentence(figures)
    figures["pruning"] = page.pruning(figures)
    figures["warnings"] = wording.nothing_drawn([figures["fragments_per_pixel"]])
    lines = [page.text(figures), *(f"Warning: {each}" for each in figures["warnings"])]
    if out is not None:
        with replacing(out / FIGURES) as path:
            path.write_text(json.dumps(records.strict(figures), indent=1) + "\n", encoding="utf-8")
        with replacing(out / PAGE) as path:
            path.write_text(page.compose(figures, out), encoding="utf-8")
        lines.append(f"Wrote {out / PAGE} and {FIGURES}.")
    return command.Report(figures | {"page": out and str(out / PAGE)}, "\n".join(lines))


def _given(cameras: Path | None, scene: options.SceneOptions, count: int) -> placing.Placed:
    """Cameras of a file or a scene folder, ``count`` at most, evenly spread."""
    if cameras is not None:
        named = load_cameras(cameras, white_background=scene.white_background)
    else:
        assert scene.data is not None
        train, test = load_scene_cameras(scene.data, white_background=scene.white_background)
        named = sorted([*train, *test], key=lambda each: each[0])
    chosen = sized(list(evenly_spaced(named, count)), scene.resolution)
    if "resolution" not in scene.given:
        longest = max(max(view.width, view.height) for _, view in chosen)
        chosen = sized(chosen, Resolution(-(-longest // LARGEST)))
    why = f"{len(chosen)} of the {len(named)} cameras of {cameras or scene.data}, evenly spread."
    return placing.Placed(chosen, "given", why)
