"""What pages of results show: views before and after under dividers, tables, learning curves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fragprune_plugins.files.atomic import replacing
from fragprune_plugins.workbench.figures import page

if TYPE_CHECKING:
    from torch import Tensor

    from fragprune_plugins.engines import Engine
    from fragprune_plugins.workbench.figures.evaluate import Candidate
    from fragprune_plugins.workbench.scenes.dataset import Shot

LEARNING = "learning.png"
SHOWN = 3
"""Views on the page."""

_MODELS = ("before", "after")


@dataclass(frozen=True)
class Drawn:
    """Views that were drawn for a page, on shared scales.

    Attributes:
        names: of the views: how their files begin.
        sizes: of their pictures: width and height, pixels.
        fragments: of each view, drawn per pixel before and after.
        most_fragments: per pixel, at the top of the scale.
        most_error: difference to the photograph at the top of the scale, 8-bit levels.
    """

    names: Sequence[str]
    sizes: Sequence[page.Size]
    fragments: Sequence[tuple[float, float]]
    most_fragments: float
    most_error: float

    @property
    def files(self) -> list[str]:
        """Names of all pictures."""
        kinds = ["photograph", *_MODELS]
        kinds += [f"{model}_{shown}" for model in _MODELS for shown in ("fragments", "error")]
        return [f"{name}_{kind}.png" for name in self.names for kind in kinds]


def draw_views(
    folder: Path, before: Candidate, after: Candidate, shots: Sequence[Shot], engine: Engine
) -> Drawn:
    """Draw some evenly spread views: photograph, before, after, and maps of both.

    The maps show the fragments of each pixel, and the largest difference of a channel to the
    photograph.

    Args:
        folder: for the PNGs, which ``Drawn.files`` names.
        before: the model before fine-tuning.
        after: the model to compare with ``before``.
        shots: the views; they move to the models' device.
        engine: draws the views.
    """
    import torch

    from fragprune_plugins.learning.stage2 import evenly
    from fragprune_plugins.workbench.figures.pictures import save_image, save_map, stems

    models = [(before, before.model.splats()), (after, after.model.splats())]
    chosen = [shot.to(before.model.xyz.device) for shot in evenly(shots, SHOWN)]
    names = stems([shot.name for shot in chosen])
    maps: dict[str, dict[str, Tensor]] = {"fragments": {}, "error": {}}
    counted = []
    for name, shot in zip(names, chosen, strict=True):
        save_image(folder / f"{name}_photograph.png", shot.image)
        per_pixel = []
        for model, (each, splats) in zip(_MODELS, models, strict=True):
            with torch.no_grad():
                out = each.draw(engine, shot.view, splats, counts=True)
            assert out.fragments is not None
            save_image(folder / f"{name}_{model}.png", out.image)
            seen = shot.looked_at(out.image)
            error = (seen.clamp(0, 1) - shot.image.clamp(0, 1)).abs().amax(dim=0)
            maps["fragments"][f"{name}_{model}"] = out.fragments
            maps["error"][f"{name}_{model}"] = 255 * error
            per_pixel.append(float(out.fragments_per_pixel))
        counted.append((per_pixel[0], per_pixel[1]))
    limits = {}
    for kind, values in maps.items():
        limits[kind] = shared_limit(list(values.values()))
        for stem, each_map in values.items():
            save_map(folder / f"{stem}_{kind}.png", each_map, limits[kind])
    sizes = [(shot.view.width, shot.view.height) for shot in chosen]
    return Drawn(names, sizes, counted, limits["fragments"], limits["error"])


def save_banner(
    path: Path, before: Candidate, after: Candidate, shot: Shot, engine: Engine
) -> None:
    """Draw one view before and after, and the fragments of both, side by side.

    Args:
        path: the PNG or JPG.
        before: the model before fine-tuning.
        after: the model after it.
        shot: the view.
        engine: draws it.
    """
    import torch

    from fragprune_plugins.workbench.figures.pictures import save_panel

    with torch.no_grad():
        was, now = (
            each.draw(engine, shot.view, each.model.splats(), counts=True)
            for each in (before, after)
        )
    assert was.fragments is not None
    assert now.fragments is not None
    panels = [("before", was.image), ("after", now.image)]
    for name, out, counts in (("before", was, was.fragments), ("after", now, now.fragments)):
        panels.append((f"{name}: {float(out.fragments_per_pixel):.1f} fragments/pixel", counts))
    save_panel(path, panels, shared_limit([was.fragments, now.fragments]))


def shared_limit(maps: Sequence[Tensor]) -> float:
    """The value that one pixel in 200 of all maps exceeds: the top of their colour scale."""
    import torch

    values = torch.cat([each.flatten() for each in maps]).float()
    at = min(len(values), int(0.995 * len(values)) + 1)
    return max(1.0, float(values.kthvalue(at).values))


def views(drawn: Drawn, source: Callable[[str], str]) -> list[str]:
    """The drawn views as parts of a page.

    Args:
        drawn: what ``draw_views`` gave.
        source: turns a picture's file name into its ``src``, a relative path or a data URL.
    """
    if not drawn.names:
        return []
    parts = []
    for name, size, (was, now) in zip(drawn.names, drawn.sizes, drawn.fragments, strict=True):

        def both(kind: str, caption: str, name: str = name, size: page.Size = size) -> str:
            left, right = (source(f"{name}_{model}{kind}.png") for model in _MODELS)
            return page.split(left, right, caption, size, _MODELS)

        photograph = source(f"{name}_photograph.png")
        parts.append(
            page.section(
                name,
                both("", "Drawn before and after"),
                page.picture(photograph, "Photograph", size),
                both("_fragments", f"Fragments per pixel: {was:.1f} before, {now:.1f} after"),
                both("_error", "Difference to the photograph"),
            )
        )
    zoom = max(map(page.zoom, drawn.sizes))
    shown = f" Pixels are shown {zoom} times as large." if zoom > 1 else ""
    return [
        page.heading("Before and after"),
        page.paragraph(f"{_DIVIDERS}{shown}"),
        page.legend("fragments drawn in a pixel", drawn.most_fragments),
        page.legend(
            "difference to the photograph, 8-bit levels, largest channel", drawn.most_error
        ),
        *parts,
    ]


def figures(columns: Mapping[str, dict[str, Any]]) -> str:
    """A table of measurements by name of the model, with the change between the last two."""
    from fragprune_plugins.workbench.figures.wording import measured_with, tabulate

    head, *rows = tabulate(columns)
    return page.table(head, rows, measured_with(columns))


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


_DIVIDERS = """Held-out views. Drag a divider: the model before is left of it, the model after is
right of it. The dividers of a view move together."""
