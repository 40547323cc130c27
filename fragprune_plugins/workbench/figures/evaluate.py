"""Measures quality, fragments and latency of splats against photographs or own pictures."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import count
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import EngineError, InputError
from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.area import SQUARED_RADIUS
from fragprune_plugins.plugins.hooks import drawn_by, engine_for, thresholds_for
from fragprune_plugins.types import RasterInputs, RasterOutputs, Splats, View, one_line
from fragprune_plugins.workbench.figures.clock import Made, standard_error, timed
from fragprune_plugins.workbench.figures.extents import covered
from fragprune_plugins.workbench.figures.metrics import lpips, mean, psnr, ssim
from fragprune_plugins.workbench.models import model as models
from fragprune_plugins.workbench.ranks import launched
from fragprune_plugins.workbench.scenes.dataset import Dataset, Shot, shots_of

REPEATS = 9
_COUNTED = ("fragments_per_pixel", "evaluated_per_pixel", "entries_per_pixel")
SILENT = 2.0  # seconds of measuring before a bar shows how far it is


@dataclass(frozen=True, eq=False)
class Candidate:
    """A model to measure, and how to draw it; plugins are asked for thresholds at every view."""

    model: Model
    drawing: Mapping[str, Any] = field(default_factory=dict)
    """Fields of ``RasterInputs`` that differ from vanilla's rules."""
    gaussians: int | None = None  # of the whole splat, where the model is this process' part of it
    cut: Tensor | None = None  # (N,) thresholds to draw with as they are, in place of the model's

    __repr__ = one_line

    def thresholds(self, inputs: RasterInputs) -> Tensor | None:
        """(N,) to draw a view with; None for no truncation."""
        return thresholds_for(inputs, self.model.thresholds if self.cut is None else self.cut)

    @cached_property
    def splats(self) -> Splats:
        """The activated Gaussians."""
        return self.model.splats()

    def sharing(self, **others: Any) -> Candidate:
        """The same Gaussians, drawn otherwise; they are activated once for both."""
        other = replace(self, **others)
        vars(other)["splats"] = self.splats
        return other

    def inputs(self, view: View) -> RasterInputs:
        """The inputs of one view; only the image is asked for."""
        return RasterInputs(view, self.splats, planes=(), **{**self.model.rules, **self.drawing})

    def draw(self, engine: Engine, view: View, *, counts: bool = False) -> RasterOutputs:
        """Draw one view, optionally with counts of fragments."""
        inputs = replace(self.inputs(view), counts=counts)
        outputs = drawn_by(engine, inputs, self.thresholds(inputs))
        size = tuple(getattr(outputs.image, "shape", ()))
        if size != (3, view.height, view.width):  # a plugin's engine may give anything
            found, expected = f"an image of shape {size}", f"(3, {view.height}, {view.width})"
            raise EngineError(f"engine {engine.name}", found, expected, "Choose another --engine.")
        if wrong := int(outputs.image.isnan().any(dim=0).sum()):
            found = f"NaN in {wrong} of {view.width * view.height} pixels"
            remedy = "Look for vast numbers in the model, or choose another --engine."
            raise EngineError(f"engine {engine.name}", found, "a picture", remedy)
        return outputs


def measure(
    model: Model | models.Trained | str | Path,
    dataset: Dataset | Sequence[Shot],
    *,
    engine: str | Engine = "auto",
    repeats: int = REPEATS,
) -> dict[str, Any]:
    """Measure a model: its quality, what it draws, and the time of a frame.

    A frame is one forward rasterization of activated Gaussians with given thresholds, without
    reading or writing images. On a GPU it ends when the GPU is idle.

    Args:
        model: what to measure, the result of a training, or a file.
        dataset: its held-out views count; or the views. Figures are means over them.
        engine: a name or an engine.
        repeats: number of timed frames for each view.

    Returns:
        target ("photographs", or "itself" for a model's own pictures), psnr (dB; equal views
        count only where all are equal: infinite), ssim, lpips (None where not installed),
        fragments_per_pixel, evaluated_per_pixel, entries_per_pixel (NaN from an engine that does
        not count them), area_per_pixel (``covered_per_pixel``), gaussians, frame_ms (median over
        views and repeats), frame_ms_se (standard error over repeats of the median over views),
        engine, device, views.

    Raises:
        EngineError: no such engine here.
        InputError: pictures smaller than 11x11 pixels, or no view.
    """
    shots = shots_of("measure", dataset.test if isinstance(dataset, Dataset) else dataset)
    return measure_all([Candidate(models.of(model))], shots, engine=engine, repeats=repeats)[0]


@torch.no_grad()
def measure_all(
    candidates: Sequence[Candidate],
    shots: Sequence[Shot],
    *,
    engine: str | Engine = "auto",
    repeats: int = REPEATS,
    enlarge: int = 1,
) -> list[dict[str, Any]]:
    """Measure models, all on one device, against the same pictures: the figures of ``measure``.

    Frames of all are timed in turns, so that a busy machine slows them alike; they are ``enlarge``
    times as wide and high as the pictures.
    """
    device = candidates[0].model.device
    engine = engine_for(engine, device)
    if not shots or repeats < 1:
        found = f"{len(shots)} views and {repeats} repeats"
        raise InputError("measure", found, "at least one of each", "Pass views; raise repeats.")
    shots = [shot.to(device) for shot in shots]
    reports: list[dict[str, Any]] = []
    for candidate in candidates:
        rows: list[dict[str, float | None]] = []
        for shot in bar(shots, "measuring"):
            outputs, picture = candidate.draw(engine, shot.view), shot.image
            seen = shot.looked_at(outputs.image)
            rows.append(
                {
                    "psnr": psnr(seen, picture),
                    "ssim": ssim(seen, picture),
                    "lpips": lpips(seen, picture),
                    **{name: float(getattr(outputs, name)) for name in _COUNTED},
                    "area_per_pixel": covered_per_pixel(engine, candidate.inputs(shot.view)),
                }
            )
        means = {name: _mean([row[name] for row in rows]) for name in rows[0]}
        whole = candidate.gaussians or len(candidate.model)
        reports.append({"target": shots[0].target, **means, "gaussians": whole})

    views = [enlarged(shot.view, enlarge) for shot in shots]
    frames = frame_times(candidates, views, engine, repeats=repeats)
    for report, frame in zip(reports, frames, strict=True):
        report |= frame | {"engine": engine.name, "device": str(device), "views": len(shots)}
    return reports


def enlarged(view: View, times: int) -> View:
    """The same view in a picture so many times as wide and high."""
    return replace(view, width=times * view.width, height=times * view.height)


@torch.no_grad()
def psnrs(
    candidate: Candidate, shots: Sequence[Shot], engine: Engine
) -> tuple[list[float], list[float]]:
    """PSNR of each view, dB, and the fragments per pixel of each."""
    figures, fragments = [], []
    for shot in shots:
        shot = shot.to(candidate.model.device)
        outputs = candidate.draw(engine, shot.view)
        figures.append(psnr(shot.looked_at(outputs.image), shot.image))
        fragments.append(float(outputs.fragments_per_pixel))
    return figures, fragments


def bar(items: Sequence[Made], what: str) -> Iterable[Made]:
    """The items, with a bar that shows how far they are; of several processes one shows it."""
    bar: Iterable[Made] = tqdm(items, what, leave=False, delay=SILENT, disable=not launched().first)
    return bar


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return mean(known) if len(known) == len(values) else None


@torch.no_grad()
def covered_per_pixel(engine: Engine, inputs: RasterInputs) -> float:
    """Pixels in the Gaussians' ellipses of sqrt(8) standard deviations, per pixel; counted.

    Viewers that ignore thresholds and faintness draw quads, whose area is 4 / pi times as large.
    """
    assert isinstance(inputs.splats, Splats)
    squared = torch.full_like(inputs.splats.opacities, SQUARED_RADIUS)
    return float(covered(engine, inputs, squared).fragments_per_pixel)


@torch.no_grad()
def frame_times(
    candidates: Sequence[Candidate],
    views: Sequence[View],
    engine: Engine,
    *,
    repeats: int = REPEATS,
) -> list[dict[str, float]]:
    """Time frames of splats in turns: frame_ms and frame_ms_se of each, as those of ``measure``."""
    turns = rounds(candidates, views, engine)
    times = [next(turns) for _ in bar(range(repeats), "timing frames")]
    found = []
    for repeated in zip(*times, strict=True):
        error = standard_error([statistics.median(frames) for frames in repeated])
        middle = statistics.median(ms for frames in repeated for ms in frames)
        found.append({"frame_ms": middle, "frame_ms_se": error})
    return found


def rounds(
    candidates: Sequence[Candidate], views: Sequence[View], engine: Engine
) -> Iterator[list[list[float]]]:
    """Frames of candidates in turns, without end: for each of them the milliseconds by view."""
    order = list(enumerate(candidates))
    for turn in count():
        spent: list[list[float]] = [[] for _ in candidates]
        for number, view in enumerate(views):
            # Of two neither is always the one that finds a cold cache.
            for index, candidate in order[:: 1 if (turn + number) % 2 else -1]:
                inputs = candidate.inputs(view)
                frame = partial(engine.rasterize, inputs, candidate.thresholds(inputs))
                spent[index].append(timed(frame, candidate.model.device)[1])
        yield spent
