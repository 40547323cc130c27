"""An HTML page of results: a sentence, a table, sliders over views, learning curves."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING

from fragprune_plugins.storage.atomic import replacing

if TYPE_CHECKING:
    from torch import Tensor

    from fragprune_plugins.datasets.dataset import Shot
    from fragprune_plugins.engines import Engine
    from fragprune_plugins.measure.evaluate import Candidate

LEARNING = "learning.png"
_SHOWN = 3  # views on the page


def draw_views(
    folder: Path, before: Candidate, after: Candidate, shots: Sequence[Shot], engine: Engine
) -> dict[str, list[str]]:
    """Draw some evenly spread views: photograph, before, after, fragment densities.

    Args:
        folder: for the PNGs.
        before: the model before fine-tuning.
        after: the model to compare with ``before``.
        shots: the views; they move to the models' device.
        engine: draws the views.

    Returns:
        Files by the name of the view: its photograph, before, after, fragments.
    """
    import torch

    from fragprune_plugins.learning.stage2 import evenly
    from fragprune_plugins.measure.pictures import save_image, save_panel, stems

    views = {}
    models = [("before", before, before.model.splats()), ("after", after, after.model.splats())]
    chosen = evenly(shots, _SHOWN)
    for stem, shot in zip(stems([shot.name for shot in chosen]), chosen, strict=True):
        shot = shot.to(before.model.xyz.device)
        with torch.no_grad():
            drawn = {
                name: each.draw(engine, shot.view, splats, counts=True)
                for name, each, splats in models
            }
        images = {"photograph": shot.image} | {name: out.image for name, out in drawn.items()}
        for name, image in images.items():
            save_image(folder / f"{stem}_{name}.png", image)
        counts = [
            (f"{name}: {float(out.fragments_per_pixel):.1f} per pixel", out.fragments)
            for name, out in drawn.items()
            if out.fragments is not None
        ]
        limit = float(torch.cat([c.flatten() for _, c in counts]).float().quantile(0.999))
        save_panel(folder / f"{stem}_fragments.png", counts, limit)
        views[stem] = [f"{stem}_{name}.png" for name in (*images, "fragments")]
    return views


def save_learning(
    path: Path, curves: Sequence[dict[str, float]], thresholds: Tensor | None
) -> None:
    """Draw loss, fragments and median threshold over the steps, and all thresholds at the end.

    Args:
        path: the PNG.
        curves: one dict a step, from a run's summary; None, in records, is what is not known.
        thresholds: (N,) learned, falloff; None, of a control, leaves out what shows them.
    """
    import numpy as np
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shown = 2 if thresholds is None else 4
    figure = Figure(figsize=(3.75 * shown, 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    loss, fragments, *others = figure.subplots(1, shown)
    steps = np.array([row["step"] for row in curves])
    window = max(1, min(50, len(steps) // 4))
    for axes, key, color, label in (
        (loss, "loss", "tab:purple", "loss, without the pressure"),
        (fragments, "fragments_per_pixel", "tab:red", "drawn fragments per pixel"),
    ):
        values = np.array([row[key] for row in curves], dtype=float)
        mean = np.convolve(values, np.ones(window) / window, mode="valid")
        axes.plot(steps, values, color=color, alpha=0.25, linewidth=0.8)
        axes.plot(steps[window // 2 :][: len(mean)], mean, color=color)
        axes.set(xlabel="step", ylabel=label, ylim=(0, None))
    if thresholds is not None:
        median, spread = others
        medians = np.array([row["threshold_median"] for row in curves], dtype=float)
        median.plot(steps, medians, color="tab:green")
        median.set(xlabel="step", ylabel="median threshold (falloff)", ylim=(0, None))
        final = thresholds.detach().cpu().numpy()
        spread.hist(np.maximum(final, 1e-4), bins=np.geomspace(1e-4, 1, 60), color="tab:blue")
        spread.set(xscale="log", xlabel="threshold (falloff)", ylabel="Gaussians")
    for axes in (loss, fragments, *others):
        axes.grid(alpha=0.25)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)


def compose(
    *,
    title: str,
    quote: str,
    text: Sequence[str],
    views: Sequence[str],
    pictures: Sequence[tuple[str, str]],
    source: Callable[[str], str],
    ending: Sequence[str] = (),
) -> str:
    """Compose the page as HTML.

    Args:
        title: also its heading.
        quote: the outcome in a sentence, shown large.
        text: paragraphs and tables, HTML.
        views: names of views that ``draw_views`` drew; each has a slider.
        pictures: (heading, file) of further pictures at full width.
        source: turns a picture's file name into its ``src``, a relative path or a data URL.
        ending: paragraphs and tables below the pictures, HTML.
    """
    sections = [_view(name, source) for name in views]
    sections += [
        f'<h2>{html.escape(heading)}</h2>\n<img class="wide" src="{source(file)}" alt="">'
        for heading, file in pictures
    ]
    return _PAGE.substitute(
        title=html.escape(title),
        quote=html.escape(quote),
        body="\n".join([*text, *sections, *ending]),
    )


def preformatted(text: str) -> str:
    """Preformatted text, such as a table, as HTML."""
    return f"<pre>{html.escape(text)}</pre>"


def paragraph(text: str) -> str:
    """A paragraph of text as HTML."""
    return f"<p>{html.escape(text)}</p>"


def _view(name: str, source: Callable[[str], str]) -> str:
    names: Mapping[str, str] = {
        kind: html.escape(source(f"{name}_{kind}.png"))
        for kind in ("photograph", "before", "after", "fragments")
    }
    return _VIEW.substitute(names)


_VIEW = Template("""<section>
<div class="pair">
<img src="$after" alt="after">
<img class="top" src="$before" alt="before">
<input type="range" min="0" max="100" value="50" aria-label="before or after"
 oninput="this.previousElementSibling.style.clipPath='inset(0 '+(100-this.value)+'% 0 0)'">
<span class="left">before</span><span class="right">after</span>
</div>
<img class="photo" src="$photograph" alt="photograph">
<img class="wide" src="$fragments" alt="fragments per pixel">
</section>""")

_PAGE = Template("""<!doctype html>
<html lang="en"><meta charset="utf-8"><title>$title</title>
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
<h1>$title</h1>
<p class="quote">$quote</p>
$body
</html>
""")
