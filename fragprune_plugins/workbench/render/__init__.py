"""``fragprune render``: draws pictures of a splat with the thresholds of its sidecar."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from fragprune_plugins.errors import UsageError
from fragprune_plugins.workbench.commands.common import (
    CAMERAS_HELP,
    FILE,
    MODEL,
    Command,
    Number,
    Report,
    cameras_of,
    engine_options,
    image_options,
    load_shots,
    one_voice,
    open_engine,
    photographs_for,
    require_several,
    shard_option,
    truncation_option,
    views_option,
)
from fragprune_plugins.workbench.models import model as models
from fragprune_plugins.workbench.ranks import Ranks, joined


def _direction(
    ctx: click.Context, param: click.Parameter, value: str
) -> tuple[float, float, float]:
    """Three numbers that are not all 0."""
    try:
        x, y, z = (float(part) for part in value.split(","))
    except ValueError as error:
        raise click.BadParameter(f"{value!r} is not a direction such as 0,-1,0.") from error
    if not 0 < x * x + y * y + z * z < float("inf"):
        raise click.BadParameter(f"{value!r} has no direction.")
    return x, y, z


def _map_of(picture: Path) -> Path:
    """Where a picture's map of fragments lies."""
    return picture.with_name(picture.stem + "_fragments.png")


@click.command("render", cls=Command)
@click.argument("model", type=MODEL)
@click.option(
    "--cameras",
    type=FILE,
    help=f"{CAMERAS_HELP}.",
)
@click.option("--data", type=FILE, help="Scene folder whose cameras draw, instead of --cameras.")
@click.option(
    "--out",
    type=FILE,
    required=True,
    help="Folder for the PNG files; or a film in .mp4, whose camera goes through the cameras in "
    "their order.",
)
@click.option("--orbit", is_flag=True, help="Go around MODEL instead, once; it suits an object.")
@click.option(
    "--up",
    default="0,-1,0",
    show_default=True,
    metavar="X,Y,Z",
    callback=_direction,
    help="With --orbit: what is up in MODEL's world.",
)
@click.option(
    "--seconds",
    type=Number(min=0.1, max=3600),
    default=8.0,
    show_default=True,
    help="Of a film, or of --orbit.",
)
@click.option(
    "--fps",
    type=click.IntRange(1, 240),
    default=30,
    show_default=True,
    help="Frames a second of a film, or of --orbit.",
)
@click.option("--heatmap", is_flag=True, help="Also draw fragments per pixel, on one shared scale.")
@views_option
@image_options
@truncation_option
@shard_option
@engine_options
@one_voice()
def command(
    model: Path,
    cameras: Path | None,
    data: Path | None,
    out: Path,
    orbit: bool,
    up: tuple[float, float, float],
    seconds: float,
    fps: int,
    heatmap: bool,
    views: str,
    images: str,
    resolution: int,
    white_background: bool,
    no_truncation: bool,
    shard: bool,
    engine: str,
    device: str,
    threads: int | None,
) -> Report | None:
    """Render MODEL from many cameras, with one PNG for each camera, or as a film.

    The thresholds beside MODEL apply, if there are any; --no-truncation ignores them. A film needs
    the extra [video].

    \b
    Examples:
      fragprune render pruned.ply --data scene --out renders --heatmap
      fragprune render pruned.ply --cameras out/cameras.json --out renders
      fragprune render out --out renders                (the output folder of a training)
      fragprune render statue.ply --orbit --out statue.mp4
      fragprune render pruned.ply --cameras camera_path.json --out flight.mp4 --seconds 20
    """
    film = out.suffix.lower() == ".mp4"
    if film and heatmap:
        raise UsageError("options", "--heatmap with a film", "a folder for --out", "Name one.")
    if shard:
        require_several()
    if shard and film:
        found = "--shard-gaussians with a film"
        raise UsageError("options", found, "a folder for --out", "Name one.")
    if sum((cameras is not None, data is not None, orbit)) > 1:
        raise UsageError(
            "options",
            "more than one of --cameras, --data and --orbit",
            "one of them",
            "Pass one.",
        )
    if cameras is None and data is None and not orbit:
        cameras = cameras_of(model)
        if cameras is None:
            raise UsageError(
                "options",
                "neither --cameras, --data nor --orbit, and no cameras.json of a training around "
                "MODEL",
                "cameras to draw from",
                "Pass --cameras FILE, --data FOLDER or --orbit.",
            )

    from contextlib import nullcontext

    import torch
    from torch import Tensor
    from tqdm import tqdm

    from fragprune_plugins.files.atomic import writable_folder
    from fragprune_plugins.plugins.hooks import thresholds_for
    from fragprune_plugins.types import RasterInputs, RasterOutputs
    from fragprune_plugins.workbench.figures.pictures import save_heatmap, save_image, stems
    from fragprune_plugins.workbench.figures.wording import nothing_drawn
    from fragprune_plugins.workbench.finetune.processes import part_of
    from fragprune_plugins.workbench.finetune.sharded import ShardedEngine
    from fragprune_plugins.workbench.render import filming
    from fragprune_plugins.workbench.scenes.cameras import divided, load_cameras

    rasterizer, where = open_engine(engine, device, threads)
    writable_folder(out.parent if film else out)
    whole = models.load(model, truncation=not no_truncation, device="cpu" if shard else where)
    frames = max(1, round(seconds * fps))
    if data is not None:
        scene = photographs_for(model, data, images, resolution, white_background)
        named = [(shot.name, shot.view) for shot in load_shots(scene, views)]
    elif cameras is not None:
        named = load_cameras(cameras, white_background=white_background)
    else:
        named = divided(filming.orbit(whole, frames, up), resolution)
        background = torch.full((3,), float(white_background))
        named = [(name, replace(view, background=background)) for name, view in named]
    if film and not orbit:
        named = filming.along(named, frames)
    files = [out / f"{stem}.png" for stem in stems([name for name, _ in named])]
    with joined(where) if shard else nullcontext(Ranks()) as ranks:
        part = part_of(whole, ranks, where) if shard else whole
        if shard:
            rasterizer = ShardedEngine(rasterizer, ranks)
        splats = part.splats()
        drawn: dict[int, float] = {}
        maps: dict[int, Tensor] = {}

        def draw(index: int) -> RasterOutputs:
            view = named[index][1].to(where)
            inputs = RasterInputs(view, splats, counts=heatmap, planes=(), stop=part.stop)
            with torch.no_grad():
                outputs = rasterizer.rasterize(inputs, thresholds_for(inputs, part.thresholds))
            drawn[index] = float(outputs.fragments_per_pixel)
            return outputs

        last, turns = len(named) - 1, -(-len(named) // ranks.size)
        if film:
            bar = tqdm(range(len(named)), desc="filming", unit="frame", leave=None)
            filming.write_mp4(out, (draw(index).image for index in bar), fps)
            files, turns = [out], 0
        for index in ranks.share(range(turns * ranks.size)):
            outputs = draw(min(index, last))  # shards draw together, as often as each other
            if index > last:
                continue
            save_image(files[index], outputs.image)
            if outputs.fragments is not None:
                maps[index] = outputs.fragments.cpu()
        limit = max(
            ranks.gather(max((float(counts.max()) for counts in maps.values()), default=0.0))
        )
        for index, counts in maps.items():
            save_heatmap(_map_of(files[index]), counts, limit)
        everybody = ranks.gather(drawn)
    if not ranks.first:
        return None
    if heatmap:
        files = [*files, *map(_map_of, files)]
    known = {index: figure for each in everybody for index, figure in each.items()}
    fragments = list(known.values())
    mean = sum(fragments) / len(fragments)
    warnings = nothing_drawn(fragments)
    wrote = f"{out}, {len(fragments)} frames" if film else f"{len(files)} pictures to {out}"
    return Report(
        {
            "model": str(model),
            "files": [str(file) for file in files],
            "fragments_per_pixel": mean,
            "gaussians": len(whole),
            "truncated": whole.falloff is not None,
            "engine": rasterizer.name,
            "device": str(where),
            "warnings": warnings,
        },
        "\n".join(
            [
                f"Wrote {wrote} ({mean:.1f} fragments per pixel, "
                f"{'not ' * (whole.falloff is None)}truncated).",
                *(f"Warning: {each}" for each in warnings),
            ]
        ),
    )
