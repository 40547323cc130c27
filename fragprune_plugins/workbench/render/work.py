"""Draws a model from many cameras, into pictures or a film."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import torch
from torch import Tensor
from tqdm import tqdm

from fragprune_plugins.errors import UsageError
from fragprune_plugins.files.model import Model
from fragprune_plugins.workbench.commands import opening, options
from fragprune_plugins.workbench.commands.command import Report
from fragprune_plugins.workbench.commands.options import EngineOptions, SceneOptions
from fragprune_plugins.workbench.distributed import ShardedEngine, part_of
from fragprune_plugins.workbench.figures.evaluate import Candidate
from fragprune_plugins.workbench.figures.pictures import save_image, stems
from fragprune_plugins.workbench.figures.wording import nothing_drawn
from fragprune_plugins.workbench.models.model import load, writable_folder
from fragprune_plugins.workbench.ranks import Ranks, joined
from fragprune_plugins.workbench.render import filming
from fragprune_plugins.workbench.scenes.cameras import load_cameras, sized
from fragprune_plugins.workbench.scenes.dataset import load_photographs
from fragprune_plugins.workbench.scenes.generated import Named
from fragprune_plugins.workbench.scenes.output import cameras_of

FPS = 30  # frames a second of a film
FRAMES = 8 * FPS  # frames of an orbit, and of a film at least
_NO_FOLDER = (".gif", ".webm", ".mov", ".avi", ".mkv", ".png", ".jpg", ".jpeg", ".webp")


def render(
    *,
    model: Path,
    cameras: Path | None,
    out: Path,
    orbit: bool,
    up: tuple[float, float, float],
    views: str,
    scene: SceneOptions,
    no_truncation: bool,
    shard: bool,
    engine: EngineOptions,
) -> Report | None:
    """Do what ``fragprune render`` promises; its options are the arguments."""
    film = out.suffix.lower() == ".mp4"
    _expect_place(out, film=film, shard=shard)
    cameras, scene = _cameras(model, cameras, scene, orbit=orbit)
    rasterizer, device = opening.open_engine(engine)
    writable_folder(out.parent if film else out)
    filtered, drawing = opening.as_trained(model)
    place = "cpu" if shard else device
    whole = load(model, truncation=not no_truncation, filtered=filtered, device=place)
    if scene.data is not None:
        dataset = load_photographs(opening.photographs_for(model, scene))
        named = [(shot.name, shot.view) for shot in opening.chosen(dataset, views)]
    else:
        named = _views(whole, cameras, opening.over_its_background(model, scene), up)
    if film and not orbit:
        named = filming.along(named, max(FRAMES, len(named)))
    with joined(device) if shard else nullcontext(Ranks()) as ranks:
        candidate = Candidate(part_of(whole, ranks, device) if shard else whole, drawing)
        drawer = ShardedEngine(rasterizer, ranks) if shard else rasterizer
        fragments: dict[int, float] = {}

        def draw(index: int) -> Tensor:
            with torch.no_grad():
                outputs = candidate.draw(drawer, named[index][1].to(device))
            fragments[index] = float(outputs.fragments_per_pixel)
            return outputs.image

        files = [out] if film else [out / f"{n}.png" for n in stems([each for each, _ in named])]
        if film:
            bar = tqdm(range(len(named)), desc="filming", unit="frame", leave=None)
            filming.write_mp4(out, map(draw, bar), FPS)
        else:
            _save(files, draw, ranks)
        drawn = {index: each[index] for each in ranks.gather(fragments) for index in each}
    if not ranks.first:
        return None
    wrote = f"{out}, {len(drawn)} frames" if film else f"{len(files)} pictures to {out}"
    figures = {
        "model": str(model),
        "files": [str(file) for file in files],
        "gaussians": len(whole),
        "truncated": whole.falloff is not None,
        "engine": rasterizer.name,
        "device": str(device),
    }
    return _report(figures, wrote, [*drawn.values()])


def _save(files: list[Path], draw: Callable[[int], Tensor], ranks: Ranks) -> None:
    """Write a picture of each view, of several processes each its share."""
    last, turns = len(files) - 1, -(-len(files) // ranks.size)
    for index in ranks.share(range(turns * ranks.size)):
        image = draw(min(index, last))  # shards draw together, as often as each other
        if index <= last:
            save_image(files[index], image)


def _report(figures: dict[str, Any], wrote: str, fragments: list[float]) -> Report:
    """The report, with fragments per pixel of each view."""
    mean, warnings = sum(fragments) / len(fragments), nothing_drawn(fragments)
    cut = "with cutoffs" if figures["truncated"] else "without cutoffs"
    lines = [f"Wrote {wrote} ({mean:.1f} fragments per pixel, {cut})."]
    data = figures | {"fragments_per_pixel": mean, "warnings": warnings}
    return Report(data, "\n".join([*lines, *(f"Warning: {each}" for each in warnings)]))


def _expect_place(out: Path, *, film: bool, shard: bool) -> None:
    """Check, before any work, that ``out`` can be what was asked for."""
    if shard:
        options.require_several()
    if out.suffix.lower() in _NO_FOLDER:
        expected = "a folder for PNG files, or a film in .mp4"
        raise UsageError("--out", str(out), expected, "Choose another name.")
    if film:
        filming.require_encoder()


def _cameras(
    model: Path, named: Path | None, scene: SceneOptions, *, orbit: bool
) -> tuple[Path | None, SceneOptions]:
    """The file of cameras, and the options; the training's cameras and size if none is named."""
    if scene.data is not None or orbit:
        return None, scene
    if (cameras := named or cameras_of(model)) is None:
        raise UsageError(
            "options",
            "neither --cameras, --data nor --orbit, and no cameras.json of a training around MODEL",
            "cameras to draw from",
            "Pass --cameras FILE, --data FOLDER or --orbit.",
        )
    return cameras, scene if named else opening.at_its_size(model, scene)


def _views(
    whole: Model, cameras: Path | None, scene: SceneOptions, up: tuple[float, float, float]
) -> Named:
    """The named views of a file, or without one those of an orbit."""
    if cameras is not None:
        named = load_cameras(cameras, white_background=scene.white_background)
    else:
        background = torch.full((3,), float(scene.white_background))
        orbit = filming.orbit(whole, FRAMES, up)
        named = [(name, replace(view, background=background)) for name, view in orbit]
    drawn = sized(named, scene.resolution)
    width, full = (views[0][1].width for views in (drawn, named))
    if width != full and "resolution" not in scene.given:
        said = f"{width} pixels wide, as in its training; --resolution 1 draws {full}"
        click.echo(said, err=True)
    return drawn
