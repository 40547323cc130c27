"""Times engines."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import click
import torch

from fragprune_plugins.errors import UsageError
from fragprune_plugins.plugins.hooks import thresholds_for
from fragprune_plugins.types import RasterInputs
from fragprune_plugins.workbench.bench import timing
from fragprune_plugins.workbench.commands import command, opening, options
from fragprune_plugins.workbench.figures.wording import WITHIN_NOISE, faster
from fragprune_plugins.workbench.models.model import load
from fragprune_plugins.workbench.scenes.cameras import load_cameras
from fragprune_plugins.workbench.scenes.output import cameras_of

REPEATS = 9  # timed frames of each row
Size = tuple[int, int]


def bench(
    *,
    model: Path | None,
    cameras: Path | None,
    sizes: tuple[Size, ...],
    gaussians: tuple[int, ...],
    engine: options.EngineOptions,
) -> command.Report:
    """Do what ``fragprune bench`` promises; its options are the arguments."""
    rasterizer, device = opening.open_engine(engine)
    before = timing.load_average()
    if model is None:
        scenes = product(gaussians, sizes)
        cases = [each for scene in scenes for each in timing.generated(*scene, device)]
    else:
        cases = _of_model(model, cameras, sizes, device)
    say = partial(click.echo, err=True)
    results = timing.measure(cases, [rasterizer], repeats=REPEATS, say=say)
    loads = {"load_before": before, "load_after": timing.load_average()}
    machine = timing.describe_machine(device) | loads
    data = {"results": results, "saved": _saved(results), "machine": machine}
    return command.Report(data, _table(data))


def _of_model(
    model: Path, cameras: Path | None, sizes: tuple[Size, ...], device: torch.device
) -> list[timing.Case]:
    """A model from its first camera, in each image size."""
    cameras = cameras or cameras_of(model)
    if cameras is None:
        found = "no file, and no cameras.json of a training around MODEL"
        raise UsageError("--cameras", found, "a camera to draw from", "Pass --cameras FILE.")
    loaded = load(model, device=device)
    splats, first = loaded.splats(), load_cameras(cameras)[0][1].to(device)
    cases: list[timing.Case] = []
    for width, height in sizes:
        view = replace(first, width=width, height=height)
        inputs = RasterInputs(view, splats, planes=())
        cut = thresholds_for(inputs, loaded.thresholds)
        if cut is None:
            cut = torch.full_like(splats.opacities, timing.TRUNCATION)
        cases += timing.cases(model.stem, inputs, cut.detach(), loaded.rules)
    return cases


def _saved(results: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """By "scene WIDTHxHEIGHT": ratios of fragments and of time, forward; time over fragments."""
    forward, found = [row for row in results if row["pass"] == "forward"], {}
    for rows in zip(forward[::2], forward[1::2], strict=True):
        plain, cut = (row["fragments_per_pixel"] for row in rows)
        if cut > 0:
            frames = ({"frame_ms": r["ms_median"], "frame_ms_se": r["ms_se"]} for r in rows)
            time, error, differs = faster(*frames)
            name = "{scene} {width}x{height}".format(**rows[0])
            found[name] = {"fragments": plain / cut, "time": time, "time_se": error}
            found[name] |= {"beyond_noise": differs, "share": time * cut / plain}
    return found


def _phrase(saved: dict[str, Any]) -> str:
    """What was saved; of times that differ by no more than their noise there is no ratio."""
    time = f": {WITHIN_NOISE}"
    if saved["beyond_noise"]:
        time = " {time:.2f} ± {time_se:.2f}x as fast ({share:.0%} of it)".format(**saved)
    return f"{saved['fragments']:.2f}x fewer fragments, frames{time}"


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
    lines += [f"{name}: {_phrase(saved)}" for name, saved in data["saved"].items()]
    first, loads = results[0], "load unknown on this system"
    if machine["load_before"] is not None:
        loads = f"load {machine['load_before']:.1f} to {machine['load_after']:.1f}"
    lines.append(
        f"{first['engine']} engine ({machine['native']}) on {machine['gpu'] or first['device']}, "
        f"{first['threads']} threads on {machine['processor']}; {loads}"
    )
    return "\n".join(lines)
