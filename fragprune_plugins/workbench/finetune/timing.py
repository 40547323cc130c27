"""Frame times for a target: whether thresholds can reach it, and how much faster frames are now."""

from __future__ import annotations

import math
import statistics
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import UsageError
from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.pressure import CALIBRATION_VIEWS, FEWEST
from fragprune_plugins.learning.stage2 import evenly
from fragprune_plugins.types import RasterInputs
from fragprune_plugins.workbench.figures.clock import timed
from fragprune_plugins.workbench.prices.cost import Cost, work_of
from fragprune_plugins.workbench.scenes.dataset import Shot

_ROUNDS, _SECONDS = 7, 1.5  # at least


@torch.no_grad()
def require_reach(
    target: float, cost: Cost, model: Model, shots: Sequence[Shot], engine: Engine
) -> None:
    """Refuse a target time that thresholds cannot reach: pixels and Gaussians stay.

    Args:
        target: ratio of frame times, before over after.
        cost: prices of the engine on this machine.
        model: as it comes in.
        shots: the training views.
        engine: draws them.

    Raises:
        UsageError: it is out of reach.
    """
    splats, total = model.splats(), Counter[str]()
    for shot in evenly(shots, CALIBRATION_VIEWS):
        inputs = RasterInputs(shot.view, splats, planes=())
        total.update(work_of(engine.rasterize(inputs, None)))
    limit = cost.limit(total, FEWEST)
    if target >= limit:
        size = f"{shots[0].view.width}x{shots[0].view.height}"
        raise UsageError(
            "target time",
            f"{target:g}x as fast",
            f"less than {limit:.2f}x: pixels and Gaussians take the rest of a frame at {size}",
            "Lower --target-time, or remove Gaussians first.",
        )


@torch.no_grad()
def times_faster(
    before: Model,
    now: Model,
    thresholds: Callable[[RasterInputs], Tensor | None],
    shots: Sequence[Shot],
    engine: Engine,
) -> float:
    """Frame time of a model without thresholds, over that of another with them.

    The median over views of the ratio of their least times: a view that another program disturbed
    in all rounds moves it little.

    Args:
        before: drawn without thresholds and stop.
        now: drawn with them; free of gradients, for which an engine would keep states.
        thresholds: of ``now``, for a rasterization.
        shots: the views.
        engine: draws them.
    """
    old, new = before.splats(), now.splats()
    least = {True: [math.inf] * len(shots), False: [math.inf] * len(shots)}
    started, turn = time.perf_counter(), 0
    while turn < _ROUNDS or time.perf_counter() - started < _SECONDS:
        turn += 1
        for index, shot in enumerate(shots):
            for first in (True, False) if turn % 2 else (False, True):
                splats, stop = (old, None) if first else (new, now.stop)
                inputs = RasterInputs(shot.view, splats, planes=(), stop=stop)
                cut = None if first else thresholds(inputs)
                spent = timed(partial(engine.rasterize, inputs, cut), before.xyz.device)[1]
                least[first][index] = min(least[first][index], spent)
    return statistics.median(was / is_ for was, is_ in zip(least[True], least[False], strict=True))
