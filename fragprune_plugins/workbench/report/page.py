"""Pages of results: views of the original and the pruned model, figures, learning curves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.files.atomic import replacing
from fragprune_plugins.learning.stage2 import evenly_spaced
from fragprune_plugins.workbench.figures import evaluate, page, pictures
from fragprune_plugins.workbench.scenes.dataset import Shot

TEMPLATE = Path(__file__).with_name("report.html")
LEARNING = "learning.png"
SHOWN = 3  # views on the page
NAMES = ("original", "pruned")  # of the two models of a page, and of their pictures
_GREY = "#888888"  # can be read on white and on black


@dataclass(frozen=True)
class Shown:
    """A view that was drawn for a page."""

    name: str
    size: page.Size  # of its photograph
    fragments: tuple[str, str]  # drawn per pixel, of each model


@dataclass(frozen=True)
class Drawn:
    """Views that were drawn for a page, on shared scales."""

    views: Sequence[Shown] = ()
    target: str = ""  # what they were compared with, in words
    most_fragments: float = 1.0  # per pixel, at the top of the scale
    most_error: float = 1.0  # likewise, the difference to the photograph in 8-bit levels


def save(
    path: Path, template: Path, source: Callable[[str], str], values: Mapping[str, Any]
) -> None:
    """Write a page of results by ``TEMPLATE`` or one that extends it, which gets the values.

    ``source`` turns a picture's file name into its ``src``, a relative path or a data URL.
    """
    text = page.render(template, TEMPLATE.parent, source=source, names=NAMES, **values)
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def draw_views(
    folder: Path,
    original: evaluate.Candidate,
    pruned: evaluate.Candidate,
    shots: Sequence[Shot],
    engine: Engine,
    enlarge: int,
) -> Drawn:
    """Draw some evenly spread views into a folder: photograph, both models, and maps of both.

    The maps show the fragments of each pixel, and the largest difference of a channel to the
    photograph. Models are drawn ``enlarge`` times as wide and high as this.
    """
    chosen = [shot.to(original.model.device) for shot in evenly_spaced(shots, SHOWN)]
    names = pictures.stems([shot.name for shot in chosen])
    maps: dict[str, dict[str, Tensor]] = {"fragments": {}, "error": {}}
    views = []
    for name, shot in zip(names, chosen, strict=True):
        size, large = (shot.view.width, shot.view.height), evaluate.enlarged(shot.view, enlarge)
        pictures.save_image(folder / f"{name}_photograph.png", shot.image)
        per_pixel = []
        for model, each in zip(NAMES, (original, pruned), strict=True):
            with torch.no_grad():
                out = each.draw(engine, large, counts=True)
                image = out.image if enlarge == 1 else each.draw(engine, shot.view).image
            assert out.fragments is not None
            pictures.save_image(folder / f"{name}_{model}.png", out.image)
            error = shot.looked_at(image).clamp(0, 1) - shot.image.clamp(0, 1)
            maps["fragments"][f"{name}_{model}"] = out.fragments
            maps["error"][f"{name}_{model}"] = 255 * error.abs().amax(dim=0)
            per_pixel.append(f"{float(out.fragments_per_pixel):.1f}")
        views.append(Shown(name, size, (per_pixel[0], per_pixel[1])))
    limits = {}
    for kind, values in maps.items():
        limits[kind] = shared_limit(list(values.values()))
        for stem, each_map in values.items():
            pictures.save_map(folder / f"{stem}_{kind}.png", each_map, limits[kind])
    target = "Photograph" if chosen[0].target == "photographs" else "The original's own picture"
    return Drawn(views, target, limits["fragments"], limits["error"])


def save_banner(path: Path, folder: Path, view: Shown) -> None:
    """Write a view and its fragments, left of a line the original, right the pruned."""
    first, second = view.fragments
    halves = []
    for kind, said in (("", NAMES), ("_fragments", (f"{first} fragments per pixel", second))):
        files = [folder / f"{view.name}_{model}{kind}.png" for model in NAMES]
        left, right = (Image.open(file).convert("RGB") for file in files)
        width, height = left.size
        left.paste(right.crop((width // 2, 0, width, height)), (width // 2, 0))
        pen = ImageDraw.Draw(left)
        pen.line([(width // 2, 0), (width // 2, height)], "white", 2)
        font = ImageFont.load_default(height / 22)
        for at, anchor, words in ((0.02, "la", said[0]), (0.98, "ra", said[1])):
            place = (at * width, 0.02 * height)
            pen.rectangle(pen.textbbox(place, words, font, anchor), "black")
            pen.text(place, words, "white", font, anchor)
        halves.append(left)
    banner = Image.new("RGB", (2 * width + 8, height), "white")
    for at, half in enumerate(halves):
        banner.paste(half, (at * (width + 8), 0))
    with replacing(path) as temporary:
        banner.save(temporary, format="JPEG", quality=88)


def shared_limit(maps: Sequence[Tensor]) -> float:
    """The value that one pixel in 200 of all maps exceeds: the top of their colour scale."""
    values = torch.cat([each.flatten() for each in maps]).float()
    at = min(len(values), int(0.995 * len(values)) + 1)
    return max(1.0, float(values.kthvalue(at).values))


def save_learning(
    path: Path, curves: Sequence[dict[str, float]], thresholds: Tensor | None
) -> None:
    """Draw loss, fragments and median threshold over the steps, and all thresholds at the end.

    Lines and words are grey and the rest is transparent: a page may be light or dark. Without
    thresholds (N,), as of a control, what shows them is left out.
    """
    rows = 1 if thresholds is None else 2
    figure = Figure(figsize=(8, 2.8 * rows), layout="constrained", facecolor="none")
    loss, fragments, *others = figure.subplots(rows, 2).flat
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
        median.set(xlabel="step", ylabel="median cutoff (falloff)", ylim=(0, None))
        final = thresholds.detach().cpu().numpy()
        spread.hist(np.maximum(final, 1e-4), bins=np.geomspace(1e-4, 1, 60), color="tab:blue")
        spread.set(xscale="log", xlabel="cutoff (falloff)", ylabel="Gaussians")
    for axes in figure.axes:
        axes.grid(alpha=0.25)
        axes.set_facecolor("none")
        axes.tick_params(which="both", colors=_GREY)
        axes.xaxis.label.set_color(_GREY)
        axes.yaxis.label.set_color(_GREY)
        axes.spines[:].set_color(_GREY)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
