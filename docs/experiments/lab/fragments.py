"""Fragments: which Gaussians own them, how much each is seen, and where on the picture they lie."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from fragprune_plugins.constants import ALPHA_MIN
from fragprune_plugins.engines import Engine
from fragprune_plugins.engines.fragments import fragments
from fragprune_plugins.hosts.photographs import Photographs
from fragprune_plugins.types import RasterInputs
from fragprune_plugins.workbench.figures.evaluate import Candidate
from fragprune_plugins.workbench.figures.pictures import COLOURS, LABEL
from fragprune_plugins.workbench.scenes.dataset import Shot, load_photographs
from lab.catalogue import QUESTIONS
from lab.figures import save_figure
from lab.folder import Findings, Folder, markdown
from lab.scene import describe_drawing, describe_photographs, load_columns

NAME = "fragments"

_OPACITIES = (0.0, 0.05, 0.1, 0.2, 0.5, 0.8, 1.0)
_RADII = (0, 4, 8, 16, 32, 1 << 30)  # pixels, the host's three standard deviations
_WEIGHTS = (0.0, *(ALPHA_MIN * 2.0**power for power in range(-8, 8)), 1.0)
_OWNED = 2 ** np.arange(15)  # fragments of a Gaussian in a view
_TOP = (0.01, 0.1)
_POINTS = np.geomspace(1e-3, 1, 25)  # shares of Gaussians at which the plot's curve is kept
_TILES = 512  # tiles of a view whose fragments are weighed one by one


def run(
    paths: Sequence[Path],
    photographs: Photographs,
    out: Path,
    *,
    engine: Engine,
    device: torch.device,
) -> Findings:
    """Count what is missing of the experiment, with a bar on stderr.

    Args:
        paths: of the models, drawn with their thresholds; one alone is drawn without them too.
        photographs: whose held-out views are drawn.
        out: the folder.
        engine: draws and counts; the oracle weighs fragments one by one.
        device: of the models and views.

    Raises:
        RecordError: the folder holds this experiment in another configuration, or a file of it
            cannot be read.
    """
    columns, said = load_columns(paths, device)
    dataset = load_photographs(photographs).to(device)
    asked = {
        "asks": QUESTIONS[NAME],
        "models": said,
        "photographs": describe_photographs(photographs, dataset),
        "tiles": _TILES,
        **describe_drawing(engine, device),
    }
    folder = Folder(out, NAME, asked)
    parts = {}
    views = len(dataset.test)
    with tqdm(total=views * len(columns), desc="fragments", unit="view") as bar:
        for index, (label, column) in enumerate(columns.items()):
            bar.set_postfix_str(label)
            work = partial(_count, column, dataset.test, engine, bar)
            parts[label] = folder.part(index, label, work)
            bar.update((index + 1) * views - bar.n)
    return _findings(folder, parts, dataset.test[views // 2])


def weigh(inputs: RasterInputs, thresholds: Tensor | None, tiles: int) -> Tensor:
    """(F,) weights alpha T of the drawn fragments in so many tiles at most, one by one."""
    found = [each.weights[each.drawn] for each in fragments(inputs, thresholds, tiles)]
    return torch.cat([inputs.view.background.new_empty(0), *found])


@torch.no_grad()
def _count(column: Candidate, shots: Sequence[Shot], engine: Engine, bar: Any) -> dict[str, Any]:
    """Everything that the table and the plot show of one model, as plain values."""
    splats = column.splats
    owned = torch.zeros_like(splats.opacities)
    found: dict[str, Any] = {"owned": 0, "radius": 0, "weight": 0, "light": 0}
    pixels, maps = 0, []
    for shot in shots:
        outputs = column.draw(engine, shot.view, counts=True)
        mine, seen = outputs.fragments_per_gaussian, outputs.fragments
        assert mine is not None
        assert seen is not None
        inputs = column.inputs(shot.view)
        weights = weigh(inputs, column.thresholds(inputs), _TILES)
        owned += mine
        pixels += seen.numel()
        maps.append(seen.cpu().tolist())
        found["owned"] += np.histogram(_plain(mine), (*_OWNED, np.inf))[0]
        found["radius"] += _histogram(outputs.radii, _RADII, mine)
        found["weight"] += _histogram(weights, _WEIGHTS)
        found["light"] += _histogram(weights, _WEIGHTS, weights)
        bar.update()
    largest = owned.sort(descending=True).values.double().cumsum(0) / owned.sum().double()
    tops = {share: float(largest[max(0, round(share * len(owned)) - 1)]) for share in _TOP}
    return {
        "gaussians": len(splats),
        "drawn": int((owned > 0).sum()),
        "per_pixel": float(owned.sum()) / pixels,
        "top": list(tops.values()),
        "curve": [float(largest[max(0, round(x * len(owned)) - 1)]) for x in _POINTS],
        "opacity": (_histogram(splats.opacities, _OPACITIES, owned) / pixels).tolist(),
        "radius": (found["radius"] / pixels).tolist(),
        "weight": (found["weight"] / found["weight"].sum()).tolist(),
        "light": (found["light"] / found["light"].sum()).tolist(),
        "owned": (found["owned"] / len(shots)).tolist(),
        "map": maps[len(shots) // 2],
    }


def _plain(values: Tensor) -> Any:
    return values.detach().double().cpu().numpy()


def _histogram(values: Tensor, edges: Sequence[float], weights: Tensor | None = None) -> Any:
    """Sums of weights, or counts, of the values between two edges each."""
    weighed = None if weights is None else _plain(weights)
    return np.histogram(_plain(values), edges, weights=weighed)[0].astype(float)


def _between(edges: Sequence[float], form: str) -> list[str]:
    """Names of the ranges between edges."""
    last = len(edges) - 2
    return [
        f"over {low:{form}}" if at == last and high > 1e6 else f"{low:{form}} to {high:{form}}"
        for at, (low, high) in enumerate(pairwise(edges))
    ]


def _findings(folder: Folder, parts: Mapping[str, dict[str, Any]], shot: Shot) -> Findings:
    faint = _WEIGHTS.index(ALPHA_MIN)
    figures: list[tuple[str, str, Any]] = [
        ("Gaussians", "{:,.0f}", lambda p: p["gaussians"]),
        ("of them drawn in some view", "{:,.0f}", lambda p: p["drawn"]),
        ("fragments per pixel", "{:.2f}", lambda p: p["per_pixel"]),
        *(
            (f"share of the {share:.0%} with most fragments", "{:.1%}", lambda p, k=k: p["top"][k])
            for k, share in enumerate(_TOP)
        ),
        (
            "share of fragments with a weight below 1/255",
            "{:.1%}",
            lambda p: sum(p["weight"][:faint]),
        ),
        ("their share of the weights", "{:.1%}", lambda p: sum(p["light"][:faint])),
        *(
            (f"fragments per pixel, opacity {name}", "{:.2f}", lambda p, k=k: p["opacity"][k])
            for k, name in enumerate(_between(_OPACITIES, "g"))
        ),
        *(
            (f"fragments per pixel, radius {name} px", "{:.2f}", lambda p, k=k: p["radius"][k])
            for k, name in enumerate(_between(_RADII, "d"))
        ),
    ]
    rows = [
        {"figure": name, **{label: read(part) for label, part in parts.items()}}
        for name, _, read in figures
    ]
    cells = [
        [name, *(form.format(read(part)) for part in parts.values())]
        for name, form, read in figures
    ]
    scene = folder.asked["photographs"]
    text = f"""Over {scene["held_out_views"]} held-out views of {scene["folder"]}. The weight of a
fragment is what it adds to its pixel: alpha times the light that is left when its turn comes. It
is read off {_TILES} evenly spread tiles of a view at most. Radii are three standard deviations,
whatever the threshold.

{folder.measured_with()}"""
    plot = partial(_plot, parts=parts, shot=shot)
    return Findings(folder, QUESTIONS[NAME], rows, markdown(["", *parts], cells), text, plot)


def _plot(path: Path, parts: Mapping[str, dict[str, Any]], shot: Shot) -> None:
    figure = Figure(figsize=(13, 8.5), layout="constrained")
    halves: Any = figure.subfigures(2, 1, height_ratios=[5.5, 3.5])
    (owned, curve, weight), (opacity, radius, light) = halves[0].subplots(2, 3)
    wide = 0.8 / len(parts)
    for at, (label, part) in enumerate(parts.items()):
        owned.stairs(part["owned"][:-1], _OWNED, label=label, linewidth=1.5)
        curve.plot(100 * _POINTS, 100 * np.array(part["curve"]), label=label)
        weight.stairs(100 * np.array(part["weight"][1:]), _WEIGHTS[1:], linewidth=1.5)
        light.stairs(100 * np.array(part["light"][1:]), _WEIGHTS[1:], linewidth=1.5)
        for axes, key in ((opacity, "opacity"), (radius, "radius")):
            axes.bar(
                np.arange(len(part[key])) + (at - (len(parts) - 1) / 2) * wide, part[key], wide
            )
    for axes in (owned, curve, weight, light):
        axes.set_xscale("log")
        axes.grid(alpha=0.25)
    for axes in (weight, light):
        axes.axvline(ALPHA_MIN, color="0.5", linewidth=0.8)
    owned.set(xlabel="fragments of a Gaussian in a view", ylabel="Gaussians")
    owned.legend(fontsize=8)
    curve.set(xlabel="% of Gaussians, those with most first", ylabel="% of fragments")
    weight.set(xlabel="weight of a fragment; the line is 1/255", ylabel="% of fragments")
    light.set(xlabel="weight of a fragment; the line is 1/255", ylabel="% of all weight")
    for axes, edges, form, name in (
        (opacity, _OPACITIES, "g", "opacity"),
        (radius, _RADII, "d", "radius, pixels"),
    ):
        names = _between(edges, form)
        axes.set_xticks(range(len(names)), labels=names, fontsize=7)
        axes.set(xlabel=name, ylabel="fragments per pixel")
        axes.grid(alpha=0.25, axis="y")
    first, *others = halves[1].subplots(1, 1 + len(parts))
    first.imshow(shot.image.clamp(0, 1).permute(1, 2, 0).cpu().numpy())
    first.set_title("photograph", fontsize=9)
    limit = max(np.array(part["map"]).max() for part in parts.values())
    for axes, (label, part) in zip(others, parts.items(), strict=True):
        shown = axes.imshow(part["map"], vmin=0, vmax=limit, cmap=COLOURS)
        axes.set_title(label, fontsize=9)
    for axes in (first, *others):
        axes.set_axis_off()
    halves[1].colorbar(shown, ax=others, label=LABEL)
    save_figure(path, figure)
