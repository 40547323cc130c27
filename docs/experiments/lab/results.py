"""The table and the plot of an experiment."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from lab.catalogue import Experiment
from lab.figures import save_figure
from lab.folder import Findings, Folder, markdown
from lab.running import ENLARGED, Outcome

AS_IT_CAME = "as it came"
"""Label of the row of the untruncated model before any training."""

_FIGURES: dict[str, Callable[[Outcome], float]] = {
    "gaussians": lambda o: o.after["gaussians"],
    "fragments_per_pixel": lambda o: o.after["fragments_per_pixel"],
    "area_per_pixel": lambda o: o.after["area_per_pixel"],
    "psnr": lambda o: o.after["psnr"],
    "ssim": lambda o: o.after["ssim"],
    "psnr_training": lambda o: o.after["psnr_training"],
    "frame_ms": lambda o: o.after["frame_ms"],
    "speedup": lambda o: o.before["frame_ms"] / o.after["frame_ms"],
    "frame_ms_enlarged": lambda o: o.after["frame_ms_enlarged"],
    "speedup_enlarged": lambda o: o.before["frame_ms_enlarged"] / o.after["frame_ms_enlarged"],
    "train_seconds": lambda o: o.train_seconds,
}

_COLUMNS = (
    ("Gaussians", "gaussians", "{:,.0f}"),
    ("fragments/px", "fragments_per_pixel", "{:.2f}"),
    ("area/px", "area_per_pixel", "{:.2f}"),
    ("PSNR, dB", "psnr", "{:.2f}"),
    ("training views, dB", "psnr_training", "{:.2f}"),
    ("SSIM", "ssim", "{:.4f}"),
    ("frame, ms", "frame_ms", "{:.2f}"),
    ("faster", "speedup", "{:.2f}x"),
    (f"frame at {ENLARGED}x, ms", "frame_ms_enlarged", "{:.2f}"),
    (f"faster at {ENLARGED}x", "speedup_enlarged", "{:.2f}x"),
    ("against control, dB", "against_control", "{:+.2f}"),
    ("training, s", "train_seconds", "{:.0f}"),
)


def rows(experiment: Experiment, outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """One dict for the model as it came, then one for each arm.

    Args:
        experiment: what was compared.
        outcomes: of every arm with every seed.

    Returns:
        label, series, variant, iterations, and means over seeds, each with its standard deviation
        as ``KEY_spread`` (None for one seed): gaussians, fragments_per_pixel, area_per_pixel
        (``covered_per_pixel``), psnr (dB), ssim, psnr_training (on the views learned from; all else
        is on held-out views), frame_ms, speedup (frame time of the model as it came over frame_ms),
        frame_ms_enlarged and speedup_enlarged (the same with longer sides), train_seconds,
        against_control (dB, PSNR over that of the control of equal length; None where there is
        none).
    """
    came = [Outcome(each.arm, each.seed, each.before, each.before, 0.0) for each in outcomes]
    first = _means(came) | _mean("against_control", []) | _mean("train_seconds", [])
    first = {key: None if key.endswith("_spread") else value for key, value in first.items()}
    table = [{"label": AS_IT_CAME, "series": AS_IT_CAME, "variant": "", "iterations": 0} | first]
    for arm in experiment.arms:
        mine = [each for each in outcomes if each.arm == arm]
        row = {"label": arm.label, "series": arm.series, "variant": arm.variant}
        row |= {"iterations": arm.settings.iterations} | _means(mine)
        control = experiment.control_of(arm)
        theirs = {each.seed: each for each in outcomes if each.arm == control}
        gains = [o.after["psnr"] - theirs[o.seed].after["psnr"] for o in mine if o.seed in theirs]
        table.append(row | _mean("against_control", gains))
    return table


def findings(experiment: Experiment, outcomes: Sequence[Outcome], folder: Folder) -> Findings:
    """Table, page and plot of an experiment.

    Args:
        experiment: what was compared.
        outcomes: of every arm with every seed.
        folder: of the experiment.
    """
    table = rows(experiment, outcomes)
    head = ["", *(title for title, _, _ in _COLUMNS)]
    cells = [[row["label"], *(_cell(row, key, form) for _, key, form in _COLUMNS)] for row in table]
    return Findings(
        folder,
        experiment.asks,
        table,
        markdown(head, cells),
        _text(folder),
        partial(_plot, experiment=experiment, table=table),
    )


def _mean(key: str, values: Sequence[float]) -> dict[str, Any]:
    return {
        key: statistics.fmean(values) if values else None,
        f"{key}_spread": statistics.stdev(values) if len(values) > 1 else None,
    }


def _means(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    means: dict[str, Any] = {}
    for key, figure in _FIGURES.items():
        means |= _mean(key, [figure(each) for each in outcomes])
    return means


def _cell(row: dict[str, Any], key: str, form: str) -> str:
    mean, spread = row[key], row[f"{key}_spread"]
    if mean is None:
        return "-"
    text = form.format(mean)
    return text if spread is None else f"{text} ± {form.format(spread).strip('+x')}"


def _text(folder: Folder) -> str:
    asked, seeds = folder.asked, folder.asked["seeds"]
    scene = asked["photographs"]
    spread = " ± is the standard deviation over seeds." if len(seeds) > 1 else ""
    trained = ", ".join(map(str, seeds))
    return f"""Means over {scene["held_out_views"]} held-out views and seeds {trained}.{spread}
"Area" counts the pixels in all Gaussians' ellipses of sqrt(8) standard deviations, which viewers
rasterize that know no thresholds.

"Faster" is the frame time of the model {AS_IT_CAME}, without truncation, over the arm's, timed in
turns: at the photographs' size, and with sides {ENLARGED} times as long. Compare arms by this
ratio, because their frame times were taken at different moments. The control of an arm trains
equally long, moves the same parameters and truncates nothing.

* model: {asked["model"]["name"]}, SHA-256 {asked["model"]["sha256"][:12]}
* photographs: {scene["folder"]}, {scene["training_views"]} training views
{folder.measured_with()}"""


def _plot(path: Path, experiment: Experiment, table: Sequence[dict[str, Any]]) -> None:
    """Write the plot as PNG: quality over what the experiment names.

    A series "A + B" has the colour of "A", and squares.
    """
    figure = Figure(figsize=(15, 5), layout="constrained")
    panels = _PANELS[experiment.over]
    subplots = figure.subplots(1, len(panels), squeeze=False)[0]
    series_of = list(dict.fromkeys(row["series"] for row in table))
    hues = list(dict.fromkeys(series.split(" + ")[0] for series in series_of))
    for axes, panel in zip(subplots, panels, strict=True):
        for series in series_of:
            hue, *more = series.split(" + ")
            line = [row for row in table if row["series"] == series]
            line.sort(key=panel.at)
            x, y = [panel.at(row) for row in line], [row[panel.quality] for row in line]
            axes.errorbar(
                x,
                y,
                xerr=[
                    at * (row.get(f"{panel.over}_spread") or 0) / (row[panel.over] or 1)
                    for row, at in zip(line, x, strict=True)
                ],
                yerr=[row[f"{panel.quality}_spread"] or 0 for row in line],
                color=f"C{hues.index(hue)}",
                marker="*" if series == AS_IT_CAME else "s" if more else "o",
                markersize=10 if series == AS_IT_CAME else 5,
                linewidth=1.2,
                elinewidth=0.6,
                label=series,
            )
            for row, *point in zip(line, x, y, strict=True):
                axes.annotate(
                    row["variant"],
                    point,
                    xytext=(4, 4),
                    textcoords="offset points",
                    fontsize=7,
                    rotation=30,
                )
        axes.set(xlabel=panel.label, ylabel=_QUALITIES[panel.quality])
        axes.margins(0.1)
        axes.grid(alpha=0.25)
    figure.legend(*subplots[0].get_legend_handles_labels(), loc="outside right center", fontsize=8)
    save_figure(path, figure, dpi=100)


@dataclass(frozen=True)
class _Panel:
    """One panel of a plot.

    Arms are measured one after the other, maybe hours apart. Their frame times are therefore shown
    relative to those of the model as it came, which were taken in turns with them.

    Attributes:
        label: of what lies across.
        over: its key in the table.
        power: -1 shows the reciprocal.
        quality: key of what lies upwards.
    """

    label: str
    over: str
    power: int = 1
    quality: str = "psnr"

    def at(self, row: dict[str, Any]) -> float:
        """Where a row of the table lies across."""
        return float(row[self.over]) ** self.power


_QUALITIES = {"psnr": "held-out PSNR, dB", "psnr_training": "PSNR on training views, dB"}

_FRAGMENTS = _Panel("drawn fragments per pixel", "fragments_per_pixel")

_FRAMES = (
    _Panel(f"frame time / that of the model {AS_IT_CAME}", "speedup", -1),
    _Panel(f"the same, sides {ENLARGED} times as long", "speedup_enlarged", -1),
)

_PANELS = {
    "fragments": (_FRAGMENTS, *_FRAMES),
    "area": (_Panel("area per pixel", "area_per_pixel"), *_FRAMES),
    "iterations": (
        _Panel("iterations", "iterations", quality="psnr_training"),
        _Panel("iterations", "iterations"),
        _FRAGMENTS,
    ),
}
"""Panels by what an experiment's plot shows quality over."""
