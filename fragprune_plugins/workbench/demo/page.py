"""Writes the demo's pictures and its page."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from fragprune_plugins.files.atomic import replacing
from fragprune_plugins.plugins.hooks import engine_for
from fragprune_plugins.types import View
from fragprune_plugins.workbench.figures.evaluate import Candidate, frame_times
from fragprune_plugins.workbench.figures.wording import headlines, outcome
from fragprune_plugins.workbench.models import model as models
from fragprune_plugins.workbench.report import page as report_page
from fragprune_plugins.workbench.scenes.dataset import load_dataset

LARGER = 2
"""How many times as wide and high the page's pictures are as the photographs of the training."""

_REPEATS = 5  # timed frames for each view

BANNER = "banner.jpg"
"""The picture that shows all of it at a glance."""

_FIRST = "view_032.webp"  # the table stands under the divider: both halves show the same things

_TEMPLATE = Path(__file__).with_name("demo.html")


def write_page(
    out: Path,
    report: dict[str, Any],
    scene: Path,
    curves: list[dict[str, float]],
    engine: str,
    device: str,
) -> list[str]:
    """Write ``pictures/`` and ``index.html``.

    Args:
        report: the measurements; "larger" is added, frame times of pictures as large as the page's.
        curves: the run's learning curves, one dict per step.

    Returns:
        The files as paths relative to ``out``.
    """
    pictures = out / "pictures"
    paths = (Path(report["model_before"]), Path(report["model_after"]))
    one, other = (models.load(path, device=device) for path in paths)
    original, pruned = Candidate(one.untruncated()), Candidate(other)
    shots = sorted(load_dataset(scene).test, key=lambda shot: shot.name != _FIRST)
    rasterizer = engine_for(engine, device)
    views = [_larger(shot.view).to(device) for shot in shots]
    times = frame_times([original, pruned], views, rasterizer, repeats=_REPEATS)
    size = f"{views[0].width}x{views[0].height}"
    report["larger"] = {"size": size, "before": times[0], "after": times[1]}
    drawn = report_page.draw_views(pictures, original, pruned, shots, rasterizer, LARGER)
    report_page.save_banner(pictures / BANNER, pictures, drawn)
    files = [*drawn.files, BANNER]
    plots = []
    if curves and other.falloff is not None:
        report_page.save_learning(pictures / report_page.LEARNING, curves, other.falloff)
        files.append(report_page.LEARNING)
        plots = [("How it learned", report_page.LEARNING)]
    text = report_page.compose(
        _TEMPLATE,
        drawn,
        lambda file: f"pictures/{file}",
        title="The same picture from fewer fragments",
        facts=headlines(report, report["control"]),
        quote=outcome("run", report, report["control"]),
        notes=[],
        table=report_page.figures(
            {"original": report["before"], "control": report["control"], "pruned": report["after"]}
        ),
        plots=plots,
        others=[],
        folder=str(out),
    )
    with replacing(out / "index.html") as path:
        path.write_text(text, encoding="utf-8")
    return [*(f"pictures/{file}" for file in files), "index.html"]


def _larger(view: View) -> View:
    return replace(view, width=LARGER * view.width, height=LARGER * view.height)
