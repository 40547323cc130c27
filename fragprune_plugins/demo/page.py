"""The demo's page: its own words around what every report shows."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from fragprune_plugins.storage.atomic import replacing

if TYPE_CHECKING:
    from fragprune_plugins.demo.demo import DemoSettings
    from fragprune_plugins.injection.launch import RunSummary

_INTRODUCTION = """A small training repository learned this room from ray-traced photographs. Then
every Gaussian learned how far it reaches; what lies beyond is neither sorted nor blended. No line
of the repository was changed. Drag the sliders: left of the handle before, right of it after;
beside it the photograph, which neither has seen."""

_YOUR_OWN = """fragprune run -- python train.py -s scene -m out
fragprune finetune point_cloud.ply --data scene --out pruned.ply"""


def write_page(
    out: Path, report: dict[str, Any], scene: Path, summary: RunSummary, settings: DemoSettings
) -> list[str]:
    """Write ``pictures/`` and ``index.html``; returns the files, relative to ``out``."""
    from fragprune_plugins.datasets.dataset import load_dataset
    from fragprune_plugins.demo.demo import quotable
    from fragprune_plugins.measure import Candidate, report_page
    from fragprune_plugins.measure.wording import describe
    from fragprune_plugins.plugins.hooks import engine_for
    from fragprune_plugins.storage.models import load_model

    assert summary.model_before is not None
    assert summary.model_after is not None
    pictures = out / "pictures"
    models = (summary.model_before, summary.model_after)
    (one, _), (other, store) = (load_model(path, device=settings.device) for path in models)
    before, after = Candidate(one), Candidate(other, store)
    engine = engine_for(settings.engine, settings.device)
    views = report_page.draw_views(pictures, before, after, load_dataset(scene).test, engine)
    files = [file for names in views.values() for file in names]
    learning = []
    if summary.curves and store is not None:
        report_page.save_learning(pictures / report_page.LEARNING, summary.curves, store.values)
        learning = [("How it learned", report_page.LEARNING)]
        files.append(report_page.LEARNING)
    text = report_page.compose(
        title="The same picture from fewer fragments",
        quote=quotable(report),
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
