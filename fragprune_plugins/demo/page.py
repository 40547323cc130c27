"""Writes the demo's page from the parts of every report and an introduction."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fragprune_plugins.storage.atomic import replacing

_INTRODUCTION = """A small training repository learned this room from ray-traced photographs. Then
every Gaussian learned how far it reaches; fragments beyond that are neither sorted nor blended. No
line of the repository was changed. Drag the sliders: the model before is left of the handle, the
model after is right of it. Beside them is the photograph, from which neither model learned."""

_YOUR_OWN = """fragprune run -- python train.py -s scene -m out
fragprune finetune point_cloud.ply --data scene --out pruned.ply"""


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
        out: the demo's folder.
        report: the measurements.
        scene: folder of the photographs.
        curves: the run's learning curves, one dict per step.
        engine: name of the engine that draws.
        device: device of the models.

    Returns:
        The files as paths relative to ``out``.
    """
    from fragprune_plugins.datasets.dataset import load_dataset
    from fragprune_plugins.measure import Candidate, report_page
    from fragprune_plugins.measure.wording import describe, outcome
    from fragprune_plugins.plugins.hooks import engine_for
    from fragprune_plugins.storage import models

    pictures = out / "pictures"
    paths = (Path(report["model_before"]), Path(report["model_after"]))
    (one, _), (other, store) = (models.load(path, device=device) for path in paths)
    before, after = Candidate(one), Candidate(other, store)
    test, rasterizer = load_dataset(scene).test, engine_for(engine, device)
    views = report_page.draw_views(pictures, before, after, test, rasterizer)
    files = [file for names in views.values() for file in names]
    learning = []
    if curves and store is not None:
        report_page.save_learning(pictures / report_page.LEARNING, curves, store.values)
        learning = [("How it learned", report_page.LEARNING)]
        files.append(report_page.LEARNING)
    text = report_page.compose(
        title="The same picture from fewer fragments",
        quote=outcome("run", report, report["control"]),
        text=[
            report_page.paragraph(_INTRODUCTION),
            report_page.preformatted(
                describe({"before": report["before"], "after": report["after"]})
            ),
        ],
        views=list(views),
        pictures=learning,
        source=lambda file: f"pictures/{file}",
        ending=["<h2>Your own</h2>", report_page.preformatted(_YOUR_OWN)],
    )
    with replacing(out / "index.html") as path:
        path.write_text(text, encoding="utf-8")
    return [*(f"pictures/{file}" for file in files), "index.html"]
