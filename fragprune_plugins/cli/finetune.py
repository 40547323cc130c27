"""``fragprune finetune``: thresholds and opacities for a trained splat, from its photographs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from fragprune_plugins.cli.common import (
    FILE,
    Command,
    Report,
    data_options,
    describe,
    engine_options,
    gain,
    load_model,
    load_store,
    set_threads,
)
from fragprune_plugins.errors import UsageError
from fragprune_plugins.pressure import DEFAULT_PRESSURE
from fragprune_plugins.schedule import FINETUNE_ITERATIONS, QUICK_ITERATIONS, Settings


@click.command("finetune", cls=Command)
@click.argument("model", type=FILE)
@click.option("--out", type=FILE, required=True, help="The new .ply; its sidecar goes beside it.")
@data_options
@click.option("--iters", type=int, help=f"Optimizer steps; {FINETUNE_ITERATIONS} when left out.")
@click.option("--quick", is_flag=True, help=f"{QUICK_ITERATIONS} steps: most of the gain.")
@click.option(
    "--train",
    type=click.Choice(["opacity", "appearance", "all"]),
    default="opacity",
    show_default=True,
    help="What learns beside the thresholds; appearance adds SH, all adds shapes and positions.",
)
@click.option(
    "--pressure",
    type=float,
    help=f"Weight of drawn fragments per pixel in the loss; {DEFAULT_PRESSURE:g} when left out.",
)
@click.option("--target-speedup", type=float, help="Steer for this many times fewer fragments.")
@click.option("--control", is_flag=True, help="Same steps without truncation: the honest zero.")
@click.option("--seed", type=int, default=0, show_default=True, help="Of the order of views.")
@click.option("--no-truncation", is_flag=True, help="Ignore thresholds stored with MODEL.")
@click.option("--curves", type=FILE, help="Write a picture of the learning curves here (.png).")
@engine_options
def command(
    model: Path,
    out: Path,
    data: Path,
    resolution: int,
    white_background: bool,
    iters: int | None,
    quick: bool,
    train: Any,
    pressure: float | None,
    target_speedup: float | None,
    control: bool,
    seed: int,
    no_truncation: bool,
    curves: Path | None,
    engine: str,
    threads: int | None,
) -> Report:
    """Learn how far each Gaussian of MODEL must reach.

    Thresholds and opacities adapt to each other on the photographs in --data; positions, shapes
    and colours stay bit for bit (but see --train). OUT has the columns of MODEL; the thresholds go
    beside it, into OUT.fragprune.safetensors. The table compares both on views that were not
    learned from. Ctrl-C saves what was learned so far.

    \b
    Examples:
      fragprune finetune point_cloud.ply --data scene --out small.ply --quick
      fragprune finetune point_cloud.ply --data scene --out half.ply --target-speedup 2
      fragprune finetune point_cloud.ply --data scene --out zero.ply --control
    """
    settings = _settings(iters, quick, train, pressure, target_speedup, control, seed)
    if out.resolve() == model.resolve():
        raise UsageError("--out", f"{out}, the model itself", "another file", "Name a new file.")

    from fragprune_plugins import sidecar
    from fragprune_plugins.engines import create_engine
    from fragprune_plugins.errors import OutputError
    from fragprune_plugins.files import writable_folder
    from fragprune_plugins.finetuning import finetune, load_dataset, save
    from fragprune_plugins.measure import Candidate, measure

    set_threads(threads)
    writable_folder(out.parent)
    if out.is_dir():
        raise OutputError(str(out), "a folder", "a .ply file", "Name a file in it.")
    splat, thresholds = load_model(model, truncation=not (no_truncation or control))
    dataset = load_dataset(data, resolution=resolution, white_background=white_background)
    rasterizer = create_engine(engine, splat.xyz.device)
    store = None if thresholds is None else load_store(model, splat)

    result = finetune(splat, dataset, settings, store=store, engine=rasterizer, progress=True)
    save(out, result)
    if curves is not None and result.records:
        from fragprune_plugins.measure.pictures import save_curves

        save_curves(curves, result.records)
    before, after = measure(
        [Candidate(splat, thresholds), Candidate(result.model, result.thresholds)],
        dataset.test,
        engine=rasterizer,
    )
    quote = (
        f"{gain(before, after)} that were held out ({after['engine']} engine, "
        f"{result.iterations} iterations in {result.train_seconds:.0f} s)."
    )
    lines = [describe({"before": before, "after": after}), "", quote]
    if result.target_reached is False:
        lines.append(
            f"The target of {settings.target_speedup:g}x was missed: {result.speedup:.2f}x fewer "
            "fragments than untruncated. More --iters or another target may help."
        )
    if result.interrupted:
        lines.append(f"Interrupted at {result.iterations} of {settings.iterations} iterations.")
    lines.append(f"Wrote {out} and {sidecar.path_beside(out).name}.")
    return Report(
        {
            "model": str(model),
            "out": str(out),
            "before": before,
            "after": after,
            "speedup": result.speedup,
            "target_reached": result.target_reached,
            "interrupted": result.interrupted,
            "iterations": result.iterations,
            "train_seconds": result.train_seconds,
            "engine": result.engine,
            "device": after["device"],
            "adapter": None,
            "seed": seed,
            "settings": settings.as_dict(),
        },
        "\n".join(lines),
        exit_code=130 if result.interrupted else 0,
    )


def _settings(
    iters: int | None,
    quick: bool,
    train: Any,
    pressure: float | None,
    target_speedup: float | None,
    control: bool,
    seed: int,
) -> Settings:
    asked = {
        "--quick": quick,
        "--iters": iters is not None,
        "--pressure": pressure is not None,
        "--target-speedup": target_speedup is not None,
        "--control": control,
    }
    for one, other in (
        ("--quick", "--iters"),
        ("--pressure", "--target-speedup"),
        ("--control", "--pressure"),
        ("--control", "--target-speedup"),
    ):
        if asked[one] and asked[other]:
            raise UsageError("options", f"{one} with {other}", "one of the two", "Drop one.")
    default = QUICK_ITERATIONS if quick else FINETUNE_ITERATIONS
    return Settings(
        iterations=default if iters is None else iters,
        train=train,
        pressure=DEFAULT_PRESSURE if pressure is None else pressure,
        target_speedup=target_speedup,
        truncate=not control,
        seed=seed,
    )
