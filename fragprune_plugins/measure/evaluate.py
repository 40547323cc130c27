"""Quality, fragments and latency of splats on photographs, under the names of every report."""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.datasets.dataset import Shot
from fragprune_plugins.engines import Engine, create_engine
from fragprune_plugins.measure.metrics import psnr, ssim
from fragprune_plugins.storage.ply import SplatFile
from fragprune_plugins.types import RasterInputs, Splats, View

REPEATS = 9


@dataclass(frozen=True, eq=False)
class Candidate:
    """A splat and the thresholds (N,) to draw it with, None for no truncation.

    ``drawing`` holds fields of ``RasterInputs`` where other rules than vanilla's apply.
    """

    model: SplatFile
    thresholds: Tensor | None = None
    drawing: Mapping[str, Any] = field(default_factory=dict)

    def inputs(self, view: View, splats: Splats) -> RasterInputs:
        """One view of the activated model."""
        return RasterInputs(view, splats, **self.drawing)


def evaluate(
    model: SplatFile,
    thresholds: Tensor | None,
    shots: Sequence[Shot],
    *,
    engine: str | Engine = "auto",
    repeats: int = REPEATS,
) -> dict[str, Any]:
    """Measure one splat; see ``measure``."""
    return measure([Candidate(model, thresholds)], shots, engine=engine, repeats=repeats)[0]


@torch.no_grad()
def measure(
    candidates: Sequence[Candidate],
    shots: Sequence[Shot],
    *,
    engine: str | Engine = "auto",
    repeats: int = REPEATS,
) -> list[dict[str, Any]]:
    """Measure splats against the same photographs, timing them in turns.

    Frames of all candidates are timed interleaved, so that a busy machine slows them alike. A
    frame is one rasterization of activated Gaussians, forward only, without reading or writing
    images.

    Args:
        candidates: what to measure.
        shots: the views; figures are means over them.
        engine: a name or an engine.
        repeats: timed frames a view and candidate.

    Returns:
        One dict a candidate: psnr (dB), ssim, lpips (None), fragments_per_pixel,
        evaluated_per_pixel, gaussians, frame_ms (median over views and repeats), frame_ms_se
        (standard error over repeats of the median over views), engine, device, views.
    """
    if isinstance(engine, str):
        engine = create_engine(engine, candidates[0].model.xyz.device)
    drawn = [candidate.model.splats() for candidate in candidates]
    reports: list[dict[str, Any]] = []
    for candidate, splats in zip(candidates, drawn, strict=True):
        rows = []
        for shot in shots:
            outputs = engine.rasterize(candidate.inputs(shot.view, splats), candidate.thresholds)
            rows.append(
                (
                    psnr(outputs.image, shot.image),
                    ssim(outputs.image, shot.image),
                    float(outputs.fragments_per_pixel),
                    float(outputs.evaluated_per_pixel),
                )
            )
        quality, likeness, fragments, evaluated = map(statistics.fmean, zip(*rows, strict=True))
        reports.append(
            {
                "psnr": quality,
                "ssim": likeness,
                "lpips": None,
                "fragments_per_pixel": fragments,
                "evaluated_per_pixel": evaluated,
                "gaussians": len(splats),
            }
        )

    times: list[list[list[float]]] = [[] for _ in candidates]  # candidate, repeat, view
    turns = list(zip(candidates, drawn, times, strict=True))
    for _ in range(repeats):
        for rounds in times:
            rounds.append([])
        for shot in shots:
            turns.reverse()  # neither is always the one that finds a cold cache
            for candidate, splats, rounds in turns:
                inputs = candidate.inputs(shot.view, splats)
                started = time.perf_counter()
                engine.rasterize(inputs, candidate.thresholds)
                rounds[-1].append(1e3 * (time.perf_counter() - started))
    for report, rounds in zip(reports, times, strict=True):
        medians = [statistics.median(frames) for frames in rounds]
        spread = statistics.stdev(medians) if len(medians) > 1 else 0.0
        report |= {
            "frame_ms": statistics.median(ms for frames in rounds for ms in frames),
            "frame_ms_se": spread / len(medians) ** 0.5,
            "engine": engine.name,
            "device": str(candidates[0].model.xyz.device),
            "views": len(shots),
        }
    return reports
