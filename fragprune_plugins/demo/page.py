"""The demo's pictures, and a page that shows them."""

from __future__ import annotations

import html
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

from fragprune_plugins.files import replacing

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import Tensor

    from fragprune_plugins.launch import RunSummary

_SHOWN = 3  # held-out views on the page


def write_page(
    out: Path, report: dict[str, Any], scene: Path, summary: RunSummary, engine: str
) -> list[str]:
    """Write ``pictures/`` and ``index.html``; returns the files, relative to ``out``."""
    import torch

    from fragprune_plugins.cli.common import load_model
    from fragprune_plugins.engines import create_engine
    from fragprune_plugins.finetuning.dataset import load_dataset
    from fragprune_plugins.measure.pictures import save_image, save_panel
    from fragprune_plugins.types import RasterInputs

    assert summary.model_before is not None
    assert summary.model_after is not None
    pictures = out / "pictures"
    models = {
        "before": load_model(summary.model_before),
        "after": load_model(summary.model_after),
    }
    rasterizer = create_engine(engine)
    names: list[str] = []
    views = []
    shots = load_dataset(scene).test
    for shot in shots[:: max(1, len(shots) // _SHOWN)][:_SHOWN]:
        stem = Path(shot.name).stem
        with torch.no_grad():
            drawn = {
                name: rasterizer.rasterize(
                    RasterInputs(shot.view, model.splats(), counts=True), thresholds
                )
                for name, (model, thresholds) in models.items()
            }
        images = {"photograph": shot.image} | {name: o.image for name, o in drawn.items()}
        for name, image in images.items():
            save_image(pictures / f"{stem}_{name}.png", image)
            names.append(f"pictures/{stem}_{name}.png")
        counts = [
            (f"{name}: {float(o.fragments_per_pixel):.1f} per pixel", o.fragments)
            for name, o in drawn.items()
            if o.fragments is not None
        ]
        limit = float(torch.cat([c.flatten() for _, c in counts]).float().quantile(0.999))
        save_panel(pictures / f"{stem}_fragments.png", counts, limit)
        names.append(f"pictures/{stem}_fragments.png")
        views.append(stem)
    thresholds = models["after"][1]
    if summary.curves and thresholds is not None:
        save_learning(pictures / "learning.png", summary.curves, thresholds)
        names.append("pictures/learning.png")
    with replacing(out / "index.html") as path:
        path.write_text(_page(report, views, "pictures/learning.png" in names), encoding="utf-8")
    return [*names, "index.html"]


def save_learning(path: Path, curves: Sequence[dict[str, float]], thresholds: Tensor) -> None:
    """Draw loss, fragments and median threshold over the steps, and all thresholds at the end.

    Args:
        path: the PNG.
        curves: a dict per step, as a run's summary has them.
        thresholds: (N,) learned, falloff.
    """
    import numpy as np
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    loss, fragments, median, spread = figure.subplots(1, 4)
    steps = np.array([row["step"] for row in curves])
    window = max(1, min(50, len(steps) // 4))
    for axes, key, color, label in (
        (loss, "loss", "tab:purple", "loss of the host"),
        (fragments, "fragments_per_pixel", "tab:red", "drawn fragments per pixel"),
    ):
        values = np.array([row[key] for row in curves])
        mean = np.convolve(values, np.ones(window) / window, mode="valid")
        axes.plot(steps, values, color=color, alpha=0.25, linewidth=0.8)
        axes.plot(steps[window // 2 :][: len(mean)], mean, color=color)
        axes.set(xlabel="step", ylabel=label, ylim=(0, None))
    median.plot(steps, [row["threshold_median"] for row in curves], color="tab:green")
    median.set(xlabel="step", ylabel="median threshold (falloff)", ylim=(0, None))
    final = thresholds.detach().cpu().numpy()
    spread.hist(np.maximum(final, 1e-4), bins=np.geomspace(1e-4, 1, 60), color="tab:blue")
    spread.set(xscale="log", xlabel="threshold (falloff)", ylabel="Gaussians")
    for axes in (loss, fragments, median, spread):
        axes.grid(alpha=0.25)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)


def _page(report: dict[str, Any], views: list[str], learned: bool) -> str:
    from fragprune_plugins.cli.common import describe
    from fragprune_plugins.demo.story import honest, quotable

    table = describe({"before": report["before"], "after": report["after"]})
    learning = '<h2>How it learned</h2>\n<img class="wide" src="pictures/learning.png" alt="">'
    return _PAGE.substitute(
        quote=html.escape(quotable(report)),
        honest=html.escape(honest(report)),
        table=html.escape(table),
        views="\n".join(_VIEW.substitute(name=html.escape(name)) for name in views),
        learning=learning if learned else "",
    )


_VIEW = Template("""<section>
<div class="pair">
<img src="pictures/${name}_after.png" alt="after">
<img class="top" src="pictures/${name}_before.png" alt="before">
<input type="range" min="0" max="100" value="50" aria-label="before or after"
 oninput="this.previousElementSibling.style.clipPath='inset(0 '+(100-this.value)+'% 0 0)'">
<span class="left">before</span><span class="right">after</span>
</div>
<img class="photo" src="pictures/${name}_photograph.png" alt="photograph">
<img class="wide" src="pictures/${name}_fragments.png" alt="fragments per pixel">
</section>""")

_PAGE = Template("""<!doctype html>
<html lang="en"><meta charset="utf-8"><title>fragprune demo</title>
<meta name="viewport" content="width=device-width">
<style>
body { font: 16px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto; padding: 0 1rem;
  color: #222; background: #fcfbf9 }
.quote { font-size: 1.35rem; border-left: .3rem solid #d2542c; padding-left: 1rem }
pre { background: #f0ede8; padding: 1rem; overflow-x: auto; border-radius: .4rem }
section { display: grid; grid-template-columns: 1fr 1fr; gap: 1rem; margin: 2rem 0 }
.wide { grid-column: 1 / -1; width: 100% }
.pair { position: relative }
.pair img, .photo { width: 100%; display: block; border-radius: .4rem }
.pair .top { position: absolute; inset: 0; clip-path: inset(0 50% 0 0) }
.pair input { position: absolute; inset: auto 0 .5rem; width: 100%; margin: 0 }
.pair span { position: absolute; top: .5rem; padding: 0 .5rem; background: #000a; color: #fff;
  border-radius: .3rem; font-size: .8rem }
.left { left: .5rem } .right { right: .5rem }
</style>
<h1>The same picture from fewer fragments</h1>
<p class="quote">$quote</p>
<p>A small training repository learned this room from ray-traced photographs. Then every Gaussian
learned how far it reaches; what lies beyond is neither sorted nor blended. No line of the
repository was changed. Drag the sliders: left of the handle before, right of it after; beside it
the photograph, which neither has seen.</p>
<pre>$table</pre>
<p>$honest</p>
$views
$learning
<h2>Your own</h2>
<pre>fragprune run -- python train.py -s scene -m out
fragprune finetune point_cloud.ply --data scene --out small.ply</pre>
</html>
""")
