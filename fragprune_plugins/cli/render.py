"""``fragprune render``: draws pictures of a splat with the thresholds of its sidecar."""

from __future__ import annotations

from pathlib import Path

import click

from fragprune_plugins.cli.common import (
    FILE,
    MODEL,
    Command,
    Report,
    cameras_of,
    engine_options,
    image_options,
    load_shots,
    open_engine,
    photographs_for,
    truncation_option,
    views_option,
)
from fragprune_plugins.errors import UsageError
from fragprune_plugins.storage import models


@click.command("render", cls=Command)
@click.argument("model", type=MODEL)
@click.option(
    "--cameras",
    type=FILE,
    help="cameras.json of a 3DGS model, transforms*.json, or nerfstudio's camera_path.json. "
    "Default: the cameras.json that the training of MODEL wrote.",
)
@click.option("--data", type=FILE, help="Scene folder whose cameras draw, instead of --cameras.")
@click.option("--out", type=FILE, required=True, help="Folder for the PNG files.")
@click.option("--heatmap", is_flag=True, help="Also draw fragments per pixel, on one shared scale.")
@views_option
@image_options
@truncation_option
@engine_options
def command(
    model: Path,
    cameras: Path | None,
    data: Path | None,
    out: Path,
    heatmap: bool,
    views: str,
    images: str,
    resolution: int,
    white_background: bool,
    no_truncation: bool,
    engine: str,
    device: str,
    threads: int | None,
) -> Report:
    """Render MODEL from many cameras, with one PNG for each camera.

    The thresholds beside MODEL apply, if there are any; --no-truncation ignores them.

    \b
    Examples:
      fragprune render pruned.ply --data scene --out renders --heatmap
      fragprune render pruned.ply --cameras out/cameras.json --out renders
      fragprune render out --out renders                (the output folder of a training)
    """
    if cameras is not None and data is not None:
        raise UsageError("options", "both of --cameras and --data", "one of them", "Pass one.")
    if cameras is None and data is None:
        cameras = cameras_of(model)
        if cameras is None:
            raise UsageError(
                "options",
                "neither --cameras nor --data, and no cameras.json of a training around MODEL",
                "cameras to draw from",
                "Pass --cameras FILE or --data FOLDER.",
            )

    import torch

    from fragprune_plugins.datasets.cameras import load_cameras
    from fragprune_plugins.measure.pictures import save_heatmap, save_image, stems
    from fragprune_plugins.measure.wording import nothing_drawn
    from fragprune_plugins.plugins.hooks import thresholds_for
    from fragprune_plugins.storage.atomic import writable_folder
    from fragprune_plugins.types import RasterInputs

    rasterizer, where = open_engine(engine, device, threads)
    writable_folder(out)
    splat, store = models.load(model, truncation=not no_truncation, device=where)
    if data is not None:
        scene = photographs_for(model, data, images, resolution, white_background)
        shots = load_shots(scene, views)
        named = [(shot.name, shot.view) for shot in shots]
    else:
        assert cameras is not None
        named = load_cameras(cameras, white_background=white_background)
    splats = splat.splats()
    files, fragments, maps = [], [], []
    with torch.no_grad():
        for stem, (_, view) in zip(stems([name for name, _ in named]), named, strict=True):
            inputs = RasterInputs(view.to(where), splats, counts=heatmap, planes=())
            outputs = rasterizer.rasterize(inputs, thresholds_for(inputs, store))
            file = out / f"{stem}.png"
            save_image(file, outputs.image)
            files.append(file)
            fragments.append(float(outputs.fragments_per_pixel))
            if outputs.fragments is not None:
                maps.append((file.with_name(file.stem + "_fragments.png"), outputs.fragments.cpu()))
    limit = max((float(counts.max()) for _, counts in maps), default=0.0)
    for file, counts in maps:
        save_heatmap(file, counts, limit)
        files.append(file)
    mean = sum(fragments) / len(fragments)
    warnings = nothing_drawn(fragments)
    return Report(
        {
            "model": str(model),
            "files": [str(file) for file in files],
            "fragments_per_pixel": mean,
            "gaussians": len(splat),
            "truncated": store is not None,
            "engine": rasterizer.name,
            "device": str(splat.xyz.device),
            "warnings": warnings,
        },
        "\n".join(
            [
                f"Wrote {len(files)} pictures to {out} ({mean:.1f} fragments per pixel, "
                f"{'truncated' if store is not None else 'not truncated'}).",
                *(f"Warning: {each}" for each in warnings),
            ]
        ),
    )
