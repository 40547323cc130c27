"""Signals: lines and small pictures drawn with few primitives, Gaussians or truncated ones.

There is no scene and no camera. Primitives lie on the image and are blended by an engine, under
the rules for splats: dilation, alpha of 0.99 at most, the 1/255 skip, front to back. A line is a
picture one pixel high. All signals and seeds of one number of primitives are fitted at once, each
in a place of its own in one large picture, where no other's primitives reach.
"""

from __future__ import annotations

import hashlib
import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from fragprune_plugins.constants import DILATION, TILE
from fragprune_plugins.engines import Engine
from fragprune_plugins.reprs import one_line
from fragprune_plugins.types import Footprints, RasterInputs, RasterOutputs, View
from fragprune_plugins.workbench.demo.textures import displayed, photograph
from fragprune_plugins.workbench.prices.machine import describe_machine
from lab.catalogue import QUESTIONS
from lab.figures import new_figure, save_figure
from lab.folder import Findings, Folder, markdown

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NAME = "signals"

ITERATIONS = 1000
LENGTH, SIDE = 256, 64
"""Pixels of a line, and of a picture's side."""

_WARMUP = 0.5  # share of the steps before anything is truncated; later is better held out
_OPENS = 0.01  # falloff where thresholds start: the 1/255 skip decides for opacities up to 0.39
_RATES = {"place": 0.5, "size": 0.05, "angle": 0.05, "opacity": 0.05, "colour": 0.02}
_THRESHOLD_RATE = 0.05
_DECAY = 0.1  # rates fall to this share over the run


@dataclass(frozen=True)
class Layout:
    """Where signals of one kind lie in the large picture, and how many primitives they get.

    Attributes:
        name: of the kind, in the plural.
        height: pixels of one signal.
        width: likewise.
        parameters: numbers that a Gaussian has; a truncated one has one more.
        counts: of truncated primitives; all can be stated in Gaussians of as many parameters.
        shown: the count that the plot shows fits of.
    """

    name: str
    height: int
    width: int
    parameters: int
    counts: tuple[int, ...]
    shown: int

    def equal(self, count: int) -> int:
        """How many Gaussians have as many parameters as so many truncated ones."""
        return count * (self.parameters + 1) // self.parameters


LINES = Layout("lines", 1, LENGTH, 4, (4, 8, 16, 32), 8)
"""A Gaussian has place, width, opacity and value."""

PICTURES = Layout("pictures", SIDE, SIDE, 9, (18, 36, 72, 144), 36)
"""A Gaussian has two coordinates, two widths, an angle, opacity and three colours."""


def lines() -> dict[str, Tensor]:
    """The lines by name, (1, LENGTH, 3) in [0, 1], grey."""
    x = (torch.arange(LENGTH) + 0.5) / LENGTH
    values = {
        "square wave": 0.2 + 0.6 * ((3 * x) % 1 < 0.5).float(),
        "step": 0.2 + 0.6 * (x > 0.45).float(),
        "sum of sines": 0.5 + 0.2 * torch.sin(4 * math.pi * x) + 0.15 * torch.cos(7 * math.pi * x),
        "scan line of a photograph": _photograph("camera.png", LENGTH)[LENGTH * 5 // 16].mean(-1),
    }
    return {name: line[None, :, None].expand(1, LENGTH, 3) for name, line in values.items()}


def pictures() -> dict[str, Tensor]:
    """The pictures by name, (SIDE, SIDE, 3) in [0, 1]."""
    y, x = torch.meshgrid(*2 * [(torch.arange(SIDE) + 0.5) / SIDE], indexing="ij")
    shapes = torch.full((SIDE, SIDE, 3), 0.15)
    shapes[0.7 * x + y < 0.6] = torch.tensor([0.9, 0.75, 0.2])
    shapes[(x - 0.65) ** 2 + (y - 0.35) ** 2 < 0.05] = torch.tensor([0.8, 0.2, 0.2])
    shapes[(abs(x - 0.45) < 0.3) & (abs(y - 0.75) < 0.14)] = torch.tensor([0.2, 0.5, 0.8])
    waves = [torch.sin(a * x + b * y + c) for a, b, c in ((7, 2, 0), (-3, 6, 1), (5, 5, 2))]
    crop = slice(SIDE // 2, SIDE // 2 + SIDE)
    return {
        "shapes": shapes,
        "waves": 0.5 + 0.25 * torch.stack(waves, dim=-1),
        "part of a photograph": _photograph("camera.png", 2 * SIDE)[:SIDE, crop],
    }


def _photograph(name: str, size: int) -> Tensor:
    return torch.from_numpy(displayed(photograph(name, size, np.random.default_rng(0)))).float()


@dataclass(frozen=True, eq=False)
class Fit:
    """Signals, fitted.

    Attributes:
        fitted: (K, S, H, W, 3) what is drawn, for K seeds and S signals.
        errors: (2, K, S) mean squared errors of held-out pixels, and of the others.
        fragments: (K, S) drawn ones per pixel.
    """

    fitted: Tensor
    errors: Tensor
    fragments: Tensor

    __repr__ = one_line


def fit(
    layout: Layout,
    targets: Tensor,
    count: int,
    seeds: Sequence[int],
    *,
    truncated: bool,
    iterations: int,
    engine: Engine,
    step: Callable[[], object] = lambda: None,
) -> Fit:
    """Fit primitives to signals by the squared error of every other pixel.

    Args:
        layout: of the signals.
        targets: (S, H, W, 3) signals in [0, 1].
        count: primitives of each signal.
        seeds: K, each for where primitives begin, and so for the order in which they are blended.
        truncated: whether primitives are truncated at thresholds that are fitted too, in the second
            half of the steps.
        iterations: steps of Adam; its rates fall tenfold.
        engine: draws.
        step: called after every step.
    """
    size = len(seeds), *targets.shape
    wanted = targets.repeat(len(seeds), 1, 1, 1)
    values = _begin(layout, wanted, count, seeds)
    groups = [{"params": [values[name]], "lr": rate} for name, rate in _RATES.items()]
    thresholds = torch.full((len(wanted) * count,), math.log(_OPENS / (1 - _OPENS)))
    if truncated:
        groups.append({"params": [thresholds.requires_grad_()], "lr": _THRESHOLD_RATE})
    optimizer = torch.optim.Adam(groups, eps=1e-15)
    falling = torch.optim.lr_scheduler.ExponentialLR(optimizer, _DECAY ** (1 / iterations))

    def draw(truncate: bool) -> tuple[Tensor, RasterOutputs]:
        inputs = _inputs(layout, values, len(wanted))
        drawn = engine.rasterize(inputs, torch.sigmoid(thresholds) if truncate else None)
        return drawn.image.reshape(3, *wanted.shape[:3]).permute(1, 2, 3, 0), drawn

    rows, columns = torch.meshgrid(*map(torch.arange, wanted.shape[1:3]), indexing="ij")
    fitted = (rows + columns) % 2 == 0  # in a picture as on a chessboard; the others are held out
    for done in range(iterations):
        image, _ = draw(truncated and done >= _WARMUP * iterations)
        error = (image - wanted).square()[:, fitted]
        optimizer.zero_grad(set_to_none=True)
        error.mean((1, 2)).sum().backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        falling.step()
        step()
    with torch.no_grad():
        made, outputs = draw(truncated)
        assert outputs.fragments is not None
        fragments = outputs.fragments.float().reshape(len(wanted), -1).mean(1)
    squared = (made.clamp(0, 1) - wanted).square()
    errors = [squared[:, where].mean((1, 2)).reshape(size[:2]) for where in (~fitted, fitted)]
    return Fit(made.reshape(size), torch.stack(errors), fragments.reshape(size[:2]))


def _begin(layout: Layout, wanted: Tensor, count: int, seeds: Sequence[int]) -> dict[str, Tensor]:
    """Primitives spread at random, in the colours of where they lie."""
    height, width = layout.height, layout.width
    each = len(wanted) // len(seeds) * count
    streams = [torch.Generator().manual_seed(seed) for seed in seeds]
    place = torch.cat([torch.rand(each, 2, generator=stream) for stream in streams])
    place = place * torch.tensor([width - 1.0, height - 1.0])
    x, y = place.round().long().unbind(1)
    room = width / count if height == 1 else (width * height / count) ** 0.5
    values = {
        "place": place,
        "size": torch.full((len(place), 2), math.log(room / 2)),
        "angle": torch.zeros(len(place)),
        "opacity": torch.zeros(len(place)),
        "colour": wanted[torch.arange(len(wanted)).repeat_interleave(count), y, x].clone(),
    }
    return {name: value.requires_grad_() for name, value in values.items()}


def _inputs(layout: Layout, values: dict[str, Tensor], places: int) -> RasterInputs:
    """All primitives on the large picture, each confined to its place."""
    height, width = layout.height * places, layout.width
    count = len(values["angle"]) // places
    top = layout.height * torch.arange(places).repeat_interleave(count)
    across = torch.full_like(top, -(-width // TILE))
    last = (top + layout.height - 1) // TILE + 1
    means, (along, down) = values["place"], ((2 * values["size"]).exp() + DILATION).unbind(1)
    colours, cos, sin = values["colour"], values["angle"].cos(), values["angle"].sin()
    if layout.height == 1:
        means = means * torch.tensor([1.0, 0.0])
        colours = colours.mean(1, keepdim=True).expand(-1, 3)
        cos, sin, down = torch.ones_like(cos), torch.zeros_like(sin), torch.full_like(down, _FLAT)
    xx, yy = cos**2 / along + sin**2 / down, sin**2 / along + cos**2 / down
    footprints = Footprints(
        means2d=means + torch.stack([0 * top, top], dim=1),
        conics=torch.stack([xx, sin * cos * (1 / along - 1 / down), yy], dim=1),
        depths=1.0 + torch.arange(len(top)),
        opacities=torch.sigmoid(values["opacity"]),
        colors=colours,
        tiles=torch.stack([0 * top, top // TILE, across, last], dim=1),
    )
    view = View.pinhole(torch.eye(3), torch.zeros(3), width=width, height=height, fx=1.0, fy=1.0)
    return RasterInputs(view, footprints, counts=True, planes=())


_FLAT = 0.01
"""Variance across a line of its primitives: lines share tiles, and do not reach each other."""


_Made = dict[tuple[str, int, bool], dict[str, Any]]
"""Finished parts by layout, number of primitives, and whether they are truncated."""

_Kinds = Sequence[tuple[Layout, dict[str, Tensor]]]


def run(
    out: Path,
    *,
    engine: Engine,
    seeds: Sequence[int] = (0, 1, 2, 3, 4),
    iterations: int = ITERATIONS,
    progress: bool = False,
) -> Findings:
    """Fit what is missing of the experiment.

    Args:
        out: the folder.
        engine: draws; it has to run on the CPU.
        seeds: one fit of every signal for each.
        iterations: of every fit.
        progress: draw a bar on stderr.

    Raises:
        RecordError: the folder holds this experiment in another configuration, or a file of it
            cannot be read.
    """
    from tqdm import tqdm

    kinds = ((LINES, lines()), (PICTURES, pictures()))
    jobs = [
        (layout, signals, count, truncated)
        for layout, signals in kinds
        for plain in layout.counts
        for count, truncated in ((plain, False), (layout.equal(plain), False), (plain, True))
    ]
    asked = {
        "asks": QUESTIONS[NAME],
        "signals": {name: _digest(each) for _, signals in kinds for name, each in signals.items()},
        "counts": {layout.name: layout.counts for layout, _ in kinds},
        "seeds": list(seeds),
        "iterations": iterations,
        "rates": {**_RATES, "threshold": _THRESHOLD_RATE, "decay": _DECAY},
        "thresholds": {"warm-up": _WARMUP, "start": _OPENS},
        "engine": engine.name,
        "threads": torch.get_num_threads(),
        "machine": describe_machine(),
    }
    folder = Folder(out, NAME, asked)
    made: _Made = {}
    with tqdm(total=len(jobs) * iterations, disable=not progress, desc="signals") as bar:
        for index, (layout, signals, count, truncated) in enumerate(jobs):
            label = f"{count} {'truncated Gaussians' if truncated else 'Gaussians'}, {layout.name}"
            bar.set_postfix_str(label)
            work = partial(
                _part,
                layout,
                torch.stack(list(signals.values())),
                count,
                seeds,
                truncated=truncated,
                iterations=iterations,
                engine=engine,
                step=bar.update,
            )
            part = folder.part(index, label, work)
            bar.update((index + 1) * iterations - bar.n)
            made[layout.name, count, truncated] = part
    return _findings(folder, kinds, made, seeds)


def _part(*what: Any, **how: Any) -> dict[str, Any]:
    """A fit as plain values: PSNR by seed and signal, and what the first seed draws."""
    done = fit(*what, **how)
    held_out, learned = (-10 * done.errors.log10()).tolist()
    drawn = (255 * done.fitted[0].clamp(0, 1)).round().int().tolist()
    fragments = done.fragments.tolist()
    return {"psnr": held_out, "psnr_fitted": learned, "fragments": fragments, "drawn": drawn}


def _digest(signal: Tensor) -> str:
    return hashlib.sha256((65535 * signal).round().int().numpy().tobytes()).hexdigest()


def _findings(folder: Folder, kinds: _Kinds, made: _Made, seeds: Sequence[int]) -> Findings:
    rows = [
        {
            "kind": layout.name,
            "signal": signal,
            "primitives": count,
            "truncated": truncated,
            "parameters": count * (layout.parameters + truncated),
            **_means("fragments_per_pixel", [each[at] for each in part["fragments"]]),
            **_means("psnr", [each[at] for each in part["psnr"]]),
            **_means("psnr_fitted", [each[at] for each in part["psnr_fitted"]]),
        }
        for layout, signals in kinds
        for at, signal in enumerate(signals)
        for (kind, count, truncated), part in made.items()
        if kind == layout.name
    ]
    found = {(row["signal"], row["primitives"], row["truncated"]): row for row in rows}
    head = ["", "primitives"]
    head += [f"{pixels}: {kind}" for pixels in ("fitted", "held out") for kind in _KINDS]
    head += ["fragments/px, Gaussians", "truncated"]
    cells = []
    for layout, signals in kinds:
        for signal in signals:
            for count in layout.counts:
                three = [
                    found[signal, number, truncated]
                    for number, truncated in (
                        (count, False),
                        (layout.equal(count), False),
                        (count, True),
                    )
                ]
                dB = [f"{row[key]:.1f}" for key in ("psnr_fitted", "psnr") for row in three]
                drawn = [f"{row['fragments_per_pixel']:.1f}" for row in (three[0], three[2])]
                cells.append([signal, str(count), *dB, *drawn])
    text = _TEXT.format(
        seeds=", ".join(map(str, seeds)),
        iterations=folder.asked["iterations"],
        measured_with=folder.measured_with(),
        counts=", ".join(
            f"{layout.equal(count)} for {count}" for layout, _ in kinds for count in layout.counts
        ),
    )
    plot = partial(_plot, kinds=kinds, made=made, rows=rows)
    return Findings(folder, QUESTIONS[NAME], rows, markdown(head, cells), text, plot)


_KINDS = ("Gaussians", "as many parameters", "truncated")

_TEXT = """PSNR in dB, means over seeds {seeds} of fits with {iterations} steps. Every other pixel
is fitted, in a picture as on a chessboard; the others are held out. A truncated Gaussian has one
number more. "As many parameters" are Gaussians with as many numbers in all ({counts}). Thresholds
open half way, without pressure on fragments. All primitives are drawn as splats are: dilated by
0.3 square pixels, blended front to back, skipped below an alpha of 1/255.

In the plot, lines and pictures are fits of the first seed, with as many parameters of both kinds.
Below the lines and beside the pictures, thick curves are fitted pixels and thin ones held-out
pixels; bars are standard deviations over seeds.

{measured_with}"""


def _means(key: str, values: Sequence[float]) -> dict[str, float | None]:
    spread = statistics.stdev(values) if len(values) > 1 else None
    return {key: statistics.fmean(values), f"{key}_spread": spread}


def _plot(path: Path, kinds: _Kinds, made: _Made, rows: Sequence[dict[str, Any]]) -> None:
    (_, flat), (_, wide) = kinds
    figure = new_figure(14, 12.5)
    parts: Any = figure.subfigures(2, 1, height_ratios=[5, 7.5])
    above, below = parts
    (one, *tops), (legend, *bottoms) = above.subplots(2, 1 + len(flat))
    _cut(one)
    for at, (signal, top, bottom) in enumerate(zip(flat, tops, bottoms, strict=True)):
        top.plot(flat[signal][0, :, 0], color="0.6", linewidth=3, label="signal")
        for truncated, (color, _) in _STYLES.items():
            drawn = _shown(LINES, made, truncated)[at][0, :, 0]
            top.plot(drawn, color=color, linewidth=1, label=_label(LINES, truncated))
        top.set(title=signal, ylim=(-0.05, 1.05), xlabel="pixel")
        _curve(bottom, signal, rows)
    legend.set_axis_off()
    legend.legend(*tops[0].get_legend_handles_labels(), fontsize=8, loc="upper left")
    legend.add_artist(legend.get_legend())
    legend.legend(*bottoms[0].get_legend_handles_labels(), fontsize=8, loc="lower left")
    grid = below.subplots(len(wide), 4, width_ratios=[1, 1, 1, 1.4])
    for at, (signal, axes) in enumerate(zip(wide, grid, strict=True)):
        shown = [(signal, wide[signal].numpy())]
        shown += [(_label(PICTURES, each), _shown(PICTURES, made, each)[at]) for each in _STYLES]
        for axis, (title, picture) in zip(axes, shown, strict=False):
            axis.imshow(picture.clip(0, 1), interpolation="nearest")
            axis.set_axis_off()
            axis.set_title(title, fontsize=9)
        _curve(axes[-1], signal, rows)
    save_figure(path, figure)


def _cut(axes: Axes) -> None:
    """One Gaussian, and what is left of it at two thresholds."""
    x = np.linspace(-40, 40, 801)
    falloff = np.exp(-((x / 12) ** 2) / 2)
    axes.plot(x, falloff, color="tab:blue", label="not truncated")
    for tau, style in ((0.2, "--"), (0.6, "-")):
        left = np.where(falloff >= tau, falloff, 0)
        axes.plot(x, left, style, color="tab:red", label=f"threshold {tau}")
    axes.set(title="one Gaussian", ylim=(-0.05, 1.35), xlabel="pixels from its centre")
    axes.legend(fontsize=7, loc="upper left")


_STYLES = {False: ("tab:blue", "Gaussians"), True: ("tab:red", "truncated Gaussians")}


def _label(layout: Layout, truncated: bool) -> str:
    count = layout.shown if truncated else layout.equal(layout.shown)
    return f"{count} {_STYLES[truncated][1]}"


def _shown(layout: Layout, made: _Made, truncated: bool) -> Any:
    """(S, H, W, 3) what the first seed draws with as many parameters."""
    count = layout.shown if truncated else layout.equal(layout.shown)
    return np.array(made[layout.name, count, truncated]["drawn"]) / 255


def _curve(axes: Axes, signal: str, rows: Sequence[dict[str, Any]]) -> None:
    """PSNR of fitted and held-out pixels over the number of parameters."""
    for truncated, (color, label) in _STYLES.items():
        mine = [row for row in rows if row["signal"] == signal and row["truncated"] == truncated]
        mine.sort(key=lambda row: int(row["parameters"]))
        for key, pixels, width in (("psnr_fitted", "fitted", 2.0), ("psnr", "held out", 0.8)):
            axes.errorbar(
                [row["parameters"] for row in mine],
                [row[key] for row in mine],
                yerr=[row[f"{key}_spread"] or 0 for row in mine],
                color=color,
                linewidth=width,
                elinewidth=0.6,
                marker="o",
                markersize=3,
                label=f"{label}, {pixels}",
            )
    numbers = [row["parameters"] for row in rows if row["signal"] == signal and row["truncated"]]
    axes.set(xscale="log", xlabel="parameters", ylabel="PSNR, dB")
    axes.set_xticks(numbers, labels=list(map(str, numbers)))
    axes.minorticks_off()
    axes.grid(alpha=0.25)
