"""``fragprune bench``: times an engine on this machine, with and without truncation."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import click

from fragprune_plugins.errors import UsageError
from fragprune_plugins.workbench.commands.common import (
    FILE,
    MODEL,
    Command,
    OutFile,
    Report,
    engine_options,
    open_engine,
)

TRUNCATION = 16 / 255
"""Threshold of all Gaussians in truncated rows; leaves 0.63 of the fragments, as learning does."""


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise UsageError("--size", repr(text), "WIDTHxHEIGHT, such as 640x480", "Correct it.")
    return int(width), int(height)


@click.command("bench", cls=Command)
@click.option(
    "--size",
    "sizes",
    multiple=True,
    default=("640x480", "1280x960"),
    show_default=True,
    help="Image size; may be given several times.",
)
@click.option(
    "--gaussians",
    multiple=True,
    type=click.IntRange(min=1),
    default=(100_000,),
    show_default=True,
    help="Number of Gaussians in the generated scene; may be given several times.",
)
@click.option("--model", type=MODEL, help="Time this model with its own thresholds instead.")
@click.option("--cameras", type=FILE, help="With --model: file of cameras; the first one draws.")
@click.option(
    "--repeats",
    type=click.IntRange(min=2),
    default=9,
    show_default=True,
    help="Number of timed frames for each row.",
)
@click.option("--forward-only", is_flag=True, help="Time the forward pass only.")
@click.option(
    "--calibrate",
    is_flag=True,
    help="Instead, measure what a pixel, a Gaussian, a list entry, an evaluated and a drawn "
    "fragment cost here, and keep the prices for finetune --target-time.",
)
@click.option(
    "--out",
    type=OutFile(".json"),
    help="With --calibrate: file for the prices, instead of the cache folder.",
)
@engine_options
@click.pass_context
def command(
    ctx: click.Context,
    sizes: tuple[str, ...],
    gaussians: tuple[int, ...],
    model: Path | None,
    cameras: Path | None,
    repeats: int,
    forward_only: bool,
    calibrate: bool,
    out: Path | None,
    engine: str,
    device: str,
    threads: int | None,
) -> Report:
    """Time rasterization, forward and with all gradients, with and without truncation.

    The generated scene is the same on every machine. All rows are timed in turns, so that a busy
    machine slows them alike. Close other programs anyway, and read the load below the table.

    \b
    Examples:
      fragprune bench
      fragprune bench --size 320x240 --size 3840x2160 --gaussians 10000 --gaussians 3000000
      fragprune bench --model point_cloud.ply --cameras cameras.json --size 1280x720
      fragprune bench --calibrate
    """
    if calibrate:
        _require_alone(ctx)
        return _calibrate(out, engine, device, threads)
    if out is not None:
        raise UsageError("options", "--out without --calibrate", "prices to write", "Remove --out.")
    if (model is None) != (cameras is None):
        raise UsageError(
            "options", "one of --model and --cameras", "both or none", "Add the other."
        )

    import torch

    from fragprune_plugins.plugins.hooks import thresholds_for
    from fragprune_plugins.types import RasterInputs
    from fragprune_plugins.workbench.bench.timing import Case, measure, scaling, translation
    from fragprune_plugins.workbench.prices.machine import describe_machine

    rasterizer, where = open_engine(engine, device, threads)
    kinds = ("forward",) if forward_only else ("forward", "forward_backward")
    cases: list[Case] = []
    scenes = _scenes(model, cameras, gaussians, sizes, where)
    for name, splats, view, store in scenes:
        cut = thresholds_for(RasterInputs(view, splats), store)
        cut = torch.full_like(splats.opacities, TRUNCATION) if cut is None else cut.detach()
        stop = None if store is None else store.stop
        for kind in kinds:
            cases += [Case(name, view, splats, kind), Case(name, view, splats, kind, cut, stop)]  # type: ignore[arg-type]
    before = os.getloadavg()[0]

    def say(text: str) -> None:
        click.echo(text, err=True)

    results = measure(cases, [rasterizer], repeats=repeats, say=say)
    machine = describe_machine(where) | {
        "load_before": before,
        "load_after": os.getloadavg()[0],
    }
    share = translation(results, rasterizer.name)
    one_scene = len({row["scene"] for row in results}) == 1
    data = {
        "results": results,
        "translation": {
            key.split()[-1] if one_scene else key: saved["share"] for key, saved in share.items()
        },
        "saved": share,
        "scaling": scaling(results, rasterizer.name),
        "machine": machine,
    }
    return Report(data, _table(data))


_OF_BENCH = ("sizes", "gaussians", "model", "cameras", "repeats", "forward_only")


def _require_alone(ctx: click.Context) -> None:
    """Refuse options that --calibrate has no use for."""
    for parameter in ctx.command.params:
        given = parameter.name and ctx.get_parameter_source(parameter.name)
        if parameter.name in _OF_BENCH and given is click.core.ParameterSource.COMMANDLINE:
            raise UsageError(
                "options",
                f"--calibrate with {parameter.opts[0]}",
                "its own scenes, sizes and rounds",
                f"Remove {parameter.opts[0]}.",
            )


def _calibrate(out: Path | None, engine: str, device: str, threads: int | None) -> Report:
    """Measure the prices of this machine and keep them."""
    from fragprune_plugins.workbench.prices.calibration import calibrate, kept_at

    rasterizer, where = open_engine(engine, device, threads)
    before = os.getloadavg()[0]
    found = calibrate(rasterizer, where, say=lambda text: click.echo(text, err=True))
    cost, path = found.cost, out or kept_at(rasterizer, where)
    cost.save(path)
    left_out = sum(frame["left_out"] for frame in found.frames)
    load = {"load_before": before, "load_after": os.getloadavg()[0]}
    data: dict[str, Any] = {
        "prices": dict(cost.prices),
        "error": cost.error,
        "machine": dict(cost.machine) | load,
        "frames": list(found.frames),
        "kept": str(path),
    }
    lines = [f"{'':<30}{'ns':>12}"]
    lines += [f"{_UNITS[unit]:<30}{price:>12,.2f}" for unit, price in cost.prices.items()]
    lines += [
        f"Predicted times of {left_out} frames left out of the fit are off by "
        f"{100 * cost.error:.0f} % (median; {len(found.frames) - left_out} frames in the fit).",
        f"{rasterizer.name} engine on {cost.machine['processor']}, {cost.machine['threads']} "
        f"threads; load {before:.1f} to {load['load_after']:.1f}",
        f"Kept in {path}.",
    ]
    return Report(data, "\n".join(lines))


_UNITS = {
    "frame": "a frame, besides",
    "pixel": "a pixel",
    "gaussian": "a Gaussian",
    "entry": "a list entry",
    "evaluated": "an evaluated fragment",
    "fragment": "a drawn fragment, on top",
}


def _scenes(
    model: Path | None,
    cameras: Path | None,
    gaussians: tuple[int, ...],
    sizes: tuple[str, ...],
    device: Any,
) -> list[tuple[str, Any, Any, Any]]:
    """(name, activated splats, view, store or None) for each count of Gaussians and image size."""
    from dataclasses import replace

    from fragprune_plugins.workbench.prices.scene import make_scene, make_view

    if model is not None and cameras is not None:
        from fragprune_plugins.workbench.models import model as models
        from fragprune_plugins.workbench.scenes.cameras import load_cameras

        loaded = models.load(model, device=device)
        view = load_cameras(cameras)[0][1].to(device)
        return [
            (model.stem, loaded.splats(), replace(view, width=w, height=h), loaded.thresholds)
            for w, h in map(_size, sizes)
        ]
    return [
        (
            f"bench-{count}",
            make_scene(count).to(device).splats(),
            make_view(*_size(size)).to(device),
            None,
        )
        for count in gaussians
        for size in sizes
    ]


def _table(data: dict[str, Any]) -> str:
    results, machine = data["results"], data["machine"]
    lines = [
        f"{'scene':<16}{'size':>11}  {'pass':<17}{'cut':<5}{'frag/px':>8}{'tested':>8}"
        f"{'median ms':>11}{'min':>9}{'±se':>7}{'ns/frag':>9}{'peak MB':>9}"
    ]
    for r in results:
        peak = "-" if r["peak_mb"] is None else f"{r['peak_mb']:.0f}"
        price = "-" if r["ns_per_fragment"] is None else f"{r['ns_per_fragment']:.2f}"
        lines.append(
            f"{r['scene']:<16}{r['width']:>6}x{r['height']:<4}  {r['pass']:<17}"
            f"{'yes' if r['truncated'] else 'no':<5}{r['fragments_per_pixel']:>8.1f}"
            f"{r['evaluated_per_pixel']:>8.1f}{r['ms_median']:>11.2f}{r['ms_min']:>9.2f}"
            f"{r['ms_se']:>7.2f}{price:>9}{peak:>9}"
        )
        if r["stages"]:
            parts = ", ".join(f"{name} {ms:.2f}" for name, ms in r["stages"].items())
            lines.append(f"{'':<29}{parts}")
    for name, saved in data["saved"].items():
        lines.append(
            f"{name}: {saved['fragments']:.2f}x fewer fragments, {saved['time']:.2f}x less time "
            f"({100 * saved['share']:.0f}% of it)"
        )
    if (prices := data["scaling"]) is not None:
        lines.append(
            f"a fragment costs {prices['least']:.2f} to {prices['most']:.2f} ns: "
            f"{prices['ratio']:.1f}x between the cheapest and the dearest scene and size"
        )
    first = results[0]
    lines.append(
        f"{first['engine']} engine ({machine['native']}) on {machine['gpu'] or first['device']}, "
        f"{first['threads']} threads on {machine['processor']}; "
        f"load {machine['load_before']:.1f} to {machine['load_after']:.1f}"
    )
    return "\n".join(lines)
