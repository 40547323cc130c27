"""Stages: where the time of a frame goes, for pictures of several sizes."""

from __future__ import annotations

import os
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from tqdm import tqdm

from fragprune_plugins.engines import Engine
from fragprune_plugins.hosts.photographs import Photographs
from fragprune_plugins.learning.stage2 import evenly_spaced
from fragprune_plugins.types import View
from fragprune_plugins.workbench.figures.clock import timed
from fragprune_plugins.workbench.figures.evaluate import Candidate
from fragprune_plugins.workbench.scenes.dataset import load_photographs
from lab.catalogue import QUESTIONS
from lab.figures import save_figure
from lab.folder import Findings, Folder, markdown
from lab.scene import describe_drawing, describe_photographs, load_columns

NAME = "stages"

SIZES = (256, 512, 1024, 2048, 3840)
"""Pixels of the longer side."""

_FULL = 2048  # pixels; half as large pictures are drawn in twice as many rounds
_VIEWS = 3
_REST = "rest"  # of a frame, outside of the engine's stages
_FRAME = "frame"


def run(
    paths: Sequence[Path],
    photographs: Photographs,
    out: Path,
    *,
    engine: Engine,
    device: torch.device,
    repeats: int,
) -> Findings:
    """Time what is missing of the experiment, with a bar on stderr.

    Args:
        paths: of the models, drawn with their thresholds; one alone is drawn without them too.
        photographs: whose held-out cameras are used, three at most.
        out: the folder.
        engine: draws; one that keeps no time of its stages shows whole frames alone.
        device: of the models and views.
        repeats: rounds for the largest pictures, more for small ones; in each, every view is drawn
            by every model in turns.

    Raises:
        RecordError: the folder holds this experiment in another configuration, or a file of it
            cannot be read.
    """
    columns, said = load_columns(paths, device)
    dataset = load_photographs(photographs).to(device)
    views = [shot.view for shot in evenly_spaced(dataset.test, _VIEWS)]
    asked = {
        "asks": QUESTIONS[NAME],
        "models": said,
        "photographs": describe_photographs(photographs, dataset),
        "views": len(views),
        "sizes": list(SIZES),
        "repeats": repeats,
        **describe_drawing(engine, device),
    }
    folder = Folder(out, NAME, asked)
    rows = []
    with tqdm(SIZES, desc="stages", unit="size") as bar:
        for index, size in enumerate(bar):
            bar.set_postfix_str(f"{size} pixels")
            rounds = repeats * max(1, _FULL // size)
            work = partial(_time, columns, [_sized(v, size) for v in views], engine, rounds)
            part = folder.part(index, f"{size} pixels", work)
            rows += _rows(part)
    return _findings(folder, rows)


def _sized(view: View, longer: int) -> View:
    """The same camera with this many pixels along the longer side."""
    factor = longer / max(view.width, view.height)
    return replace(view, width=round(factor * view.width), height=round(factor * view.height))


@torch.no_grad()
def _time(
    columns: Mapping[str, Candidate], views: Sequence[View], engine: Engine, repeats: int
) -> dict[str, Any]:
    """Milliseconds by column, round and stage, means over views; a first round is left out."""
    rounds: dict[str, list[dict[str, float]]] = {label: [] for label in columns}
    fragments = dict.fromkeys(columns, 0.0)
    order = list(columns)
    for turn in range(repeats + 1):
        found: dict[str, list[dict[str, float]]] = {label: [] for label in columns}
        for view in views:
            order.reverse()  # none is always the one that finds a cold cache
            for label in order:
                inputs = columns[label].inputs(view)
                thresholds = columns[label].thresholds(inputs)
                frame = partial(engine.rasterize, inputs, thresholds)
                outputs, spent = timed(frame, inputs.splats.device)
                stages = outputs.stages or {}
                rest = {_REST: spent - sum(stages.values())} if stages else {}
                found[label].append({**stages, **rest, _FRAME: spent})
                if not turn:
                    fragments[label] += float(outputs.fragments_per_pixel) / len(views)
        for label, frames in found.items():
            if turn:
                rounds[label].append(
                    {key: statistics.fmean(each[key] for each in frames) for key in frames[0]}
                )
    size = f"{views[0].width}x{views[0].height}"
    load = os.getloadavg()[0]
    return {"size": size, "load": load, "fragments": fragments, "rounds": rounds}


def _rows(part: dict[str, Any]) -> list[dict[str, Any]]:
    """One dict for each column and stage: its time, and how much faster it is than the first."""
    first = next(iter(part["rounds"].values()))
    rows = []
    for label, mine in part["rounds"].items():
        quickest = min(mine, key=lambda each: float(each[_FRAME]))
        for stage in mine[0]:
            times = [each[stage] for each in mine]
            faster = [b[stage] / m[stage] for b, m in zip(first, mine, strict=True) if m[stage]]
            rows.append(
                {
                    "size": part["size"],
                    "load": part["load"],
                    "model": label,
                    "fragments_per_pixel": part["fragments"][label],
                    "stage": stage,
                    **_median("ms", times),
                    "ms_quickest": quickest[stage],
                    **_median("faster", faster),
                }
            )
    return rows


def _median(key: str, values: Sequence[float]) -> dict[str, float | None]:
    """Median over rounds with its standard error, which follows from the middle half of them.

    Rounds that something else on the machine disturbed therefore do not count. For values of a
    normal distribution the error of the median is 1.2533 times that of the mean, and the middle
    half is 1.349 standard deviations wide.
    """
    if len(values) < 2:
        return {key: values[0] if values else None, f"{key}_se": None}
    low, middle, high = statistics.quantiles(values, n=4, method="inclusive")
    return {key: middle, f"{key}_se": 1.2533 / 1.349 * (high - low) / len(values) ** 0.5}


def _findings(folder: Folder, rows: Sequence[dict[str, Any]]) -> Findings:
    asked = folder.asked
    stages = list(dict.fromkeys(row["stage"] for row in rows))
    head = ["pixels", "model", "fragments/px", *(f"{stage}, ms" for stage in stages)]
    head += ["faster", "quickest, ms"]
    cells = []
    for size, label in dict.fromkeys((row["size"], row["model"]) for row in rows):
        mine = {r["stage"]: r for r in rows if (r["size"], r["model"]) == (size, label)}
        frame = mine[_FRAME]
        times = [_with_error(mine[stage], "ms") for stage in stages]
        drawn = f"{frame['fragments_per_pixel']:.1f}"
        faster, quickest = _with_error(frame, "faster", "x"), f"{frame['ms_quickest']:.2f}"
        cells.append([size, label, drawn, *times, faster, quickest])
    loads, scene = [row["load"] for row in rows], asked["photographs"]["folder"]
    text = f"""Medians over {asked["repeats"]} rounds or more ± their standard errors. In a round
every model draws each of {asked["views"]} held-out views of {scene}, in turns. "Faster" is the
first model's time over this one's in the same round. "Rest" is the frame's time outside of the
engine's stages. "Quickest" is the quickest round; the plot's bars are its stages.

The machine's load was {min(loads):.1f} to {max(loads):.1f} on {asked["machine"]["cores"]} cores.
Where it exceeds them, trust ratios and quickest rounds more than medians, most of all for small
pictures.

{folder.measured_with()}"""
    plot = partial(_plot, rows=rows, stages=[each for each in stages if each != _FRAME])
    return Findings(folder, QUESTIONS[NAME], rows, markdown(head, cells), text, plot)


def _with_error(row: dict[str, Any], key: str, unit: str = "") -> str:
    value, error = row[key], row[f"{key}_se"]
    text = "-" if value is None else f"{value:.2f}{unit}"
    return text if error is None else f"{text} ± {error:.2f}"


def _plot(path: Path, rows: Sequence[dict[str, Any]], stages: Sequence[str]) -> None:
    """The quickest round's stages for each model and size, with the median frame's error."""
    sizes = list(dict.fromkeys(row["size"] for row in rows))
    labels = list(dict.fromkeys(row["model"] for row in rows))
    figure = Figure(figsize=(2.6 * len(sizes) + 0.5, 3.6), layout="constrained")
    for axes, size in zip(figure.subplots(1, len(sizes), squeeze=False)[0], sizes, strict=True):
        mine = {(row["model"], row["stage"]): row for row in rows if row["size"] == size}
        base = [0.0] * len(labels)
        for stage in stages:
            heights = [mine[label, stage]["ms_quickest"] for label in labels]
            axes.bar(range(len(labels)), heights, bottom=base, label=stage)
            base = [low + height for low, height in zip(base, heights, strict=True)]
        frames = [mine[label, _FRAME] for label in labels]
        axes.errorbar(
            range(len(labels)),
            [frame["ms"] for frame in frames],
            yerr=[frame["ms_se"] or 0 for frame in frames],
            color="black",
            linestyle="none",
            marker="_",
            capsize=3,
            label="frame, median",
        )
        axes.set(title=size, ylim=(0, None))
        axes.set_xticks(range(len(labels)), labels=labels, rotation=20, ha="right", fontsize=8)
        axes.grid(alpha=0.25, axis="y")
        if size == sizes[0]:
            axes.set_ylabel("ms a frame")
            axes.legend(fontsize=7)
    save_figure(path, figure)
