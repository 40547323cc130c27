"""What the bridges save in each engine.

    cd tests; PYTHONPATH=../docs/experiments python -m lab.bridges OUT --scene ...

Three pages are drawn in turns in one headless Chromium: the engine alone with the unpruned model,
the engine alone with the pruned one, and the pruned one through the bridge. Engines have their
default settings. Pixels of quads are counted beside milliseconds: a software renderer shows the
work of pixels, and nothing of what a GPU's vertex units do.

PRUNED has the column trunc_threshold.
"""

from __future__ import annotations

import argparse
import json
import os
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from browser.chromium import chromium
from browser.engines import PACKAGES, drawing
from PIL import Image

from fragprune_plugins import View, load, load_cameras, rasterize
from fragprune_plugins.types import RasterInputs
from fragprune_plugins.workbench.bench.scene import make_view
from fragprune_plugins.workbench.bench.timing import describe_machine
from fragprune_plugins.workbench.figures.viewing import overview

SIZE = (1280, 720)
ENGINES = ("playcanvas", "spark")
WAYS = {
    "unpruned": ("unpruned", False),
    "pruned": ("pruned", False),
    "pruned, with the bridge": ("pruned", True),
}
"""Which model, and whether the bridge is there."""


def compare(
    browser: Any, engine: str, models: dict[str, Path], view: View, rounds: int, pictures: Path
) -> dict[str, Any]:
    """Draw a scene with an engine in all ways, in turns; times are lists of milliseconds."""
    ways: dict[str, Any] = {}
    with ExitStack() as stack:
        pages = {
            way: stack.enter_context(drawing(browser, engine, models[model], view, bridge=bridge))
            for way, (model, bridge) in WAYS.items()
        }
        shown = {way: page.picture() for way, page in pages.items()}
        for way, page in pages.items():
            Image.fromarray(shown[way]).save(
                f"{pictures}-{way.replace(', ', '-').replace(' ', '-')}.png"
            )
            ways[way] = {**page.quads(), "ms": [], "psnr": decibels(shown[way], shown["unpruned"])}
        for _ in range(rounds):
            for way, page in pages.items():
                ways[way]["ms"] += page.frames(1)
    return ways


def decibels(one: np.ndarray, other: np.ndarray) -> float | None:
    """Peak signal-to-noise ratio of two pictures of 8 bits; None if they are equal."""
    error = np.mean((one.astype(float) - other) ** 2)
    return float(10 * np.log10(255**2 / error)) if error else None


def ours(models: dict[str, Path], view: View) -> dict[str, float]:
    """Fragments per pixel of our cpu engine."""
    found = {}
    for name, path in models.items():
        model = load(path)
        inputs = RasterInputs(view, model.splats(), counts=True, planes=())
        found[name] = float(
            rasterize(inputs, model.thresholds, engine="cpu").fragments.float().mean()
        )
    return found


def camera(words: str, unpruned: Path) -> View:
    """``bench``, ``overview``, or FILE:NUMBER of a cameras file, at our size."""
    width, height = SIZE
    if words == "bench":
        return make_view(width, height)
    if words == "overview":
        return overview(load(unpruned), width=width, height=height)
    path, _, number = words.rpartition(":")
    given = load_cameras(Path(path))[int(number)][1]
    pose = given.viewmatrix.T
    focal = height / (2 * given.tan_fov_y)
    return View.pinhole(pose[:3, :3], pose[:3, 3], width=width, height=height, fx=focal, fy=focal)


def table(report: dict[str, Any]) -> str:
    """The report in Markdown."""
    versions = ", ".join(f"{name} {version}" for name, version in report["engines"].items())
    lines = [
        f"Chromium {report['chromium']}, {report['renderer']}; {versions}; {SIZE[0]}x{SIZE[1]}; "
        f"load {report['load'][0]:.1f} before and {report['load'][1]:.1f} after, "
        f"{report['machine']['cores']} cores. Median (least) of frames in turns.",
        "",
        "| scene | engine | drawn | quad pixels per pixel | ms | to its own unpruned picture, dB |",
        "|---|---|---|---|---|---|",
    ]
    gains = ["", "| scene | engine | times less with the bridge than | quad pixels | ms |"]
    gains += ["|---|---|---|---|---|"]
    for scene, of in report["scenes"].items():
        for engine in ENGINES:
            ways = of[engine]
            for way, found in ways.items():
                quads = found["pixels"] / (SIZE[0] * SIZE[1])
                psnr = "" if found["psnr"] is None else f"{found['psnr']:.1f}"
                times = f"{median(found['ms']):.0f} ({min(found['ms']):.0f})"
                lines.append(f"| {scene} | {engine} | {way} | {quads:.2f} | {times} | {psnr} |")
            best = ways["pruned, with the bridge"]
            for way, what in (("pruned", "without it"), ("unpruned", "the unpruned model")):
                pixels = ways[way]["pixels"] / best["pixels"]
                ms, least = (take(ways[way]["ms"]) / take(best["ms"]) for take in (median, min))
                gains.append(
                    f"| {scene} | {engine} | {what} | {pixels:.2f} | {ms:.2f} ({least:.2f}) |"
                )
    fragments = [
        f"{scene}: {of['fragments']['unpruned']:.1f} -> {of['fragments']['pruned']:.1f}"
        for scene, of in report["scenes"].items()
    ]
    lines += [*gains, "", f"Fragments per pixel of our cpu engine: {'; '.join(fragments)}."]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, print the table, and write bridges.json, bridges.md and the pictures."""
    parser = argparse.ArgumentParser(prog="python -m lab.bridges", description=__doc__)
    parser.add_argument("out", type=Path, help="folder to write into")
    parser.add_argument(
        "--scene",
        nargs=4,
        action="append",
        required=True,
        metavar=("NAME", "UNPRUNED", "PRUNED", "CAMERA"),
        help="CAMERA: `bench`, `overview`, or FILE:NUMBER of a cameras.json",
    )
    parser.add_argument("--rounds", type=int, default=7, help="of all in turns (7)")
    words = parser.parse_args()
    words.out.mkdir(parents=True, exist_ok=True)
    report: dict[str, Any] = {"machine": describe_machine(), "engines": PACKAGES, "scenes": {}}
    report["load"] = [os.getloadavg()[0]]
    with chromium() as browser:
        report["chromium"] = browser.version
        for name, unpruned, pruned, place in words.scene:
            models = {"unpruned": Path(unpruned), "pruned": Path(pruned)}
            view = camera(place, models["unpruned"])
            found: dict[str, Any] = {"fragments": ours(models, view)}
            report["scenes"][name] = found
            for engine in ENGINES:
                pictures = words.out / f"{name}-{engine}"
                print(f"{name}: {engine}", flush=True)
                found[engine] = compare(browser, engine, models, view, words.rounds, pictures)
        with drawing(browser, "spark", models["pruned"], view) as page:
            report["renderer"] = page.tab.renderer()
    report["load"].append(os.getloadavg()[0])
    (words.out / "bridges.json").write_text(json.dumps(report, indent=1) + "\n")
    (words.out / "bridges.md").write_text(table(report))
    print(table(report))


if __name__ == "__main__":
    main()
