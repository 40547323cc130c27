"""The viewer against itself and against usual quads.

    cd tests; PYTHONPATH=../docs/experiments python -m lab.reach OUT --scene ...

Everything is drawn in turns in one run, in one headless Chromium: a pruned model with its
thresholds, the unpruned one, and the unpruned one as most viewers draw it (every quad reaches the
square root of 8 standard deviations, and full pixels are drawn on). Pixels are counted beside
milliseconds: a software renderer shows the work of fragments, and nothing of what a GPU's geometry
units do.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from threading import Thread
from typing import Any

from browser.chromium import chromium, opened
from browser.viewing import decibels, engine_frame, frame, hold, viewing, write_page

from fragprune_plugins.files.model import Model
from fragprune_plugins.types import View
from fragprune_plugins.workbench.bench.scene import make_scene, make_view
from fragprune_plugins.workbench.bench.timing import describe_machine
from fragprune_plugins.workbench.models.model import load
from fragprune_plugins.workbench.view.site import Layer, address, make_site, open_server
from lab.bridges import SIZE, camera

WAYS = {
    "truncated": (0, {"fixed": False, "stop": True}),
    "untruncated": (1, {"fixed": False, "stop": True}),
    "truncated, no stop": (0, {"fixed": False, "stop": False}),
    "untruncated, no stop": (1, {"fixed": False, "stop": False}),
    "usual quads": (1, {"fixed": True, "stop": False}),
}
"""Which layer is drawn, and how. To stop is to leave full pixels alone."""

RATIOS = [
    ("truncated against untruncated", "untruncated", "truncated"),
    ("the same without stopping", "untruncated, no stop", "truncated, no stop"),
    ("untruncated against usual quads", "usual quads", "untruncated"),
    ("the same without stopping", "usual quads", "untruncated, no stop"),
    ("truncated against usual quads", "usual quads", "truncated"),
]


def compare(browser: Any, before: Model, after: Model, view: View, rounds: int) -> dict[str, Any]:
    """Draw a pruned and an unpruned model in all ways, in turns."""
    found: dict[str, Any] = {"gaussians": len(before), "ways": {}}
    with tempfile.TemporaryDirectory() as folder:
        write_page(Path(folder), [after, before], view)
        with viewing(browser, Path(folder), "full") as tab:
            hold(tab, view)
            times: dict[str, list[float]] = {way: [] for way in WAYS}
            for _ in range(rounds):
                for way, (layer, options) in WAYS.items():
                    tab.run(f"() => Object.assign(viewer.drawing.options, {json.dumps(options)})")
                    now = tab.run(f"() => viewer.measure({layer}, held)")
                    times[way].append(now["milliseconds"])
                    found["ways"][way] = {k: now[k] for k in ("fragments", "quads", "gaussians")}
            tab.run("() => { viewer.drawing.options.fixed = false; }")
            for way, layer, model in (("truncated", 0, after), ("untruncated", 1, before)):
                shown = frame(tab, view, layer).image
                found["ways"][way]["psnr"] = decibels(shown, engine_frame(model, view))
            assert tab.errors == []
    for way, taken in times.items():
        found["ways"][way] |= {"ms": median(taken), "least_ms": min(taken)}
    found["ratios"] = [
        {
            "what": what,
            **{
                name: found["ways"][one][name] / found["ways"][other][name]
                for name in ("fragments", "quads", "ms", "least_ms")
            },
        }
        for what, one, other in RATIOS
    ]
    return found


@contextmanager
def serving(model: Model, view: View) -> Any:
    """The command's own server with a model; its address."""
    server = open_server(make_site("cold", [model], [Layer("it", 0, False)], (), view))
    thread = Thread(target=server.serve_forever)
    thread.start()
    try:
        yield address(server)
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def cold(browser: Any, count: int, rounds: int) -> dict[str, Any]:
    """From the request of the page to its first picture; then frames while the camera turns."""
    view, first, frames = make_view(*SIZE), [], {}
    with serving(make_scene(count), view) as where:
        for _ in range(rounds):
            with opened(browser, where) as tab:
                tab.page.wait_for_function("() => window.viewer?.firstFrame", timeout=120_000)
                first.append(tab.run("() => viewer.firstFrame"))
        with opened(browser, where) as tab:
            tab.page.wait_for_function("() => window.viewer?.counted", timeout=300_000)
            frames = tab.run(
                """async () => {
                    const times = [], began = performance.now();
                    let last = began;
                    while (last - began < 10000) {
                        viewer.turn(0.02, 0);
                        do await new Promise(requestAnimationFrame); while (viewer.pending);
                        times.push(performance.now() - last);
                        last = performance.now();
                    }
                    return { times, size: viewer.quality, sort: viewer.layers[0].splats.sorted };
                }"""
            )
    return {
        "gaussians": count,
        "first_frame_ms": median(first),
        "least_first_frame_ms": min(first),
        "turning_ms": median(frames["times"]),
        "turning_size": frames["size"],
        "sort_ms": frames["sort"],
    }


def table(report: dict[str, Any]) -> str:
    """The report in Markdown."""
    lines = [
        f"Chromium {report['chromium']}, {report['renderer']}; {SIZE[0]}x{SIZE[1]}; "
        f"load {report['load'][0]:.1f} before and {report['load'][1]:.1f} after, "
        f"{report['machine']['cores']} cores. Median (least) of rounds in turns."
    ]
    for name, scene in report["scenes"].items():
        lines += [
            "",
            f"**{name}**, {scene['gaussians']:,} Gaussians",
            "",
            "| drawn | fragments per pixel | quad pixels per pixel | ms | to the cpu engine, dB |",
            "|---|---|---|---|---|",
            *(
                f"| {way} | {of['fragments']:.1f} | {of['quads']:.1f} "
                f"| {of['ms']:.0f} ({of['least_ms']:.0f}) "
                f"| {format(of['psnr'], '.1f') if 'psnr' in of else ''} |"
                for way, of in scene["ways"].items()
            ),
            "",
            "| times less | fragments | quad pixels | ms |",
            "|---|---|---|---|",
            *(
                f"| {of['what']} | {of['fragments']:.2f} | {of['quads']:.2f} "
                f"| {of['ms']:.2f} ({of['least_ms']:.2f}) |"
                for of in scene["ratios"]
            ),
        ]
    if report["cold"]:
        lines += [
            "",
            "| Gaussians | first frame, ms | while turning, ms | of its size | sort, ms |",
            "|---|---|---|---|---|",
            *(
                f"| {of['gaussians']:,} | {of['first_frame_ms']:.0f} "
                f"({of['least_first_frame_ms']:.0f}) | {of['turning_ms']:.0f} "
                f"| {of['turning_size']} | {of['sort_ms']:.0f} |"
                for of in report["cold"]
            ),
        ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, print the table, and write reach.json and reach.md."""
    parser = argparse.ArgumentParser(prog="python -m lab.reach", description=__doc__)
    parser.add_argument("out", type=Path, help="folder for reach.json and reach.md")
    parser.add_argument(
        "--scene",
        nargs=4,
        action="append",
        default=[],
        metavar=("NAME", "UNPRUNED", "PRUNED", "CAMERA"),
        help="CAMERA: `bench`, `overview`, or FILE:NUMBER of a cameras.json",
    )
    parser.add_argument("--cold", type=int, nargs="*", default=[150_000, 500_000], metavar="N")
    parser.add_argument("--rounds", type=int, default=7, help="of all in turns (7)")
    words = parser.parse_args()
    words.out.mkdir(parents=True, exist_ok=True)
    report: dict[str, Any] = {"machine": describe_machine(), "scenes": {}}
    report["load"] = [os.getloadavg()[0]]
    with chromium() as browser:
        report["chromium"] = browser.version
        for name, unpruned, pruned, place in words.scene:
            before, after, view = load(unpruned), load(pruned), camera(place, Path(unpruned))
            report["scenes"][name] = compare(browser, before, after, view, words.rounds)
        report["cold"] = [cold(browser, count, 3) for count in words.cold]
        with opened(browser, "data:text/html,") as tab:
            report["renderer"] = tab.renderer()
    report["load"].append(os.getloadavg()[0])
    (words.out / "reach.json").write_text(json.dumps(report, indent=1) + "\n")
    (words.out / "reach.md").write_text(table(report))
    print(table(report))


if __name__ == "__main__":
    main()
