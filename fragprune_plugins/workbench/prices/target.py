"""A target in frame times: prices predict a frame, and the clock has the last word."""

from __future__ import annotations

import math
import statistics
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import UsageError
from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.stage2 import evenly
from fragprune_plugins.learning.targets import CALIBRATION_VIEWS, FEWEST, Target, calibrate
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.types import RasterInputs, RasterOutputs
from fragprune_plugins.workbench.figures.clock import timed
from fragprune_plugins.workbench.prices.calibration import prices_of
from fragprune_plugins.workbench.prices.cost import Cost, work_of
from fragprune_plugins.workbench.scenes.dataset import Shot

CLOCKED_AT = (0.25, 0.45, 0.65)
"""Shares of the learning at which frames are timed, to steer by."""

LOOK_EVERY = 10
"""Steps from one look at predicted frame times to the next."""

_ROUNDS, _SECONDS = 7, 1.5  # at least
_NEAR = 0.02  # a share by which frame times are noisy


class FrameTarget(Target):
    """Meets a ratio of frame times.

    Args:
        ratio: frame time of the untruncated model as it came in, over that of the truncated one.
        cost: prices of the engine on this machine.
    """

    figure: ClassVar[str] = "faster"

    def __init__(self, ratio: float, cost: Cost) -> None:
        super().__init__(ratio)
        self.prices = cost
        self.training: Any = None
        self.seen = Ratios()  # by the clock, so far
        self.timed = 0  # of CLOCKED_AT

    def attach(self, training: Any) -> None:
        """Check that thresholds can reach the ratio.

        Raises:
            UsageError: they cannot.
        """
        model, shots = training.start, training.dataset.train
        require_reach(self.ratio, self.prices, model, shots, training.engine)
        self.training = training

    def decides(self) -> dict[str, Any]:
        """The prices, by which times are predicted."""
        return {"prices": dict(self.prices.prices)}

    def cost(self, outputs: RasterOutputs) -> float:
        """Predicted milliseconds of a frame."""
        return self.prices.ms(work_of(outputs))

    def measure(self, views: Sequence[Any]) -> float:
        """How many times as fast frames of these views are now."""
        training = self.training
        return times_faster(
            training.start,
            training.result_model(),
            training.stage.thresholds,
            views,
            training.engine,
        )

    def steers_by(self, step: int, ratio: Callable[[], float]) -> float:
        """The ratio by prices and what was timed so far, in every tenth step."""
        if step % LOOK_EVERY:
            return math.nan
        return math.exp(self.seen.slope(self.ratio) * math.log(max(ratio(), 1e-9)))

    def wants_look(self, progress: float) -> bool:
        """At some shares of the learning."""
        return self.timed < _passed(progress)

    def look(self, progress: float, ratio: Callable[[], float], views: Sequence[Any]) -> None:
        """Time frames."""
        self.timed = _passed(progress)
        self.seen.add(ratio(), self.measure(views))

    def meet(self, store: ThresholdStore, ratio: Callable[[], float], views: Sequence[Any]) -> None:
        """Shift all thresholds onto the target, by predictions that measurements correct."""
        self.met = calibrate_measured(
            store, ratio, lambda: self.measure(views), self.ratio, seen=self.seen
        )

    def state(self) -> dict[str, Any]:
        """Plain values, for ``load_state``."""
        return super().state() | {"seen": list(self.seen), "timed": self.timed}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Take over what ``state`` gave; raises ValueError for anything else."""
        super().load_state(state)
        self.seen = Ratios(self.seen)


def frame_target(
    ratio: float,
    engine: Engine,
    device: torch.device | str,
    *,
    say: Callable[[str], None] | None = None,
) -> FrameTarget:
    """A target with the prices of this machine, which are measured at the first use and kept.

    Args:
        ratio: frame time before over after.
        engine: draws.
        device: where it draws.
        say: called with a line of text before prices are measured.

    Raises:
        CostError: the kept prices are malformed, or the engine does not count its lists.
    """
    return FrameTarget(ratio, prices_of(engine, device, say=say))


def _passed(progress: float) -> int:
    return sum(progress >= share for share in CLOCKED_AT)


class Ratios(list[tuple[float, float]]):
    """Logarithms of ratios that were predicted, and measured.

    Both ratios are 1 without truncation, so that their logarithms are taken as proportional. The
    slope is fitted to all of them, in which noise cancels; those near the target weigh most.
    """

    def add(self, predicted: float, measured: float) -> None:
        """Take a pair of ratios in, unless it is too near 1 to tell a slope from noise."""
        if 1 + _NEAR < predicted < math.inf and measured > 1 + _NEAR:
            self.append((math.log(predicted), math.log(measured)))

    def slope(self, target: float) -> float:
        """ln(measured) / ln(predicted) near a target, 0.5 to 2; 1 before anything was measured."""
        weights = [1 / (_NEAR**2 + (m - math.log(target)) ** 2) for _, m in self]
        squares = sum(w * p * p for w, (p, _) in zip(weights, self, strict=True))
        if squares == 0:
            return 1.0
        products = sum(w * p * m for w, (p, m) in zip(weights, self, strict=True))
        return min(max(products / squares, 0.5), 2.0)


def calibrate_measured(
    store: ThresholdStore,
    predicted: Callable[[], float],
    measured: Callable[[], float],
    target: float,
    *,
    seen: Ratios | None = None,
    tolerance: float = 0.02,
    rounds: int = 4,
) -> float:
    """Like ``calibrate``, for a ratio that is measured with noise and predicted without.

    Bisection would go astray in noise: so it meets a prediction, and measurements correct what to
    predict (``Ratios``).

    Args:
        store: the thresholds; changed in place.
        predicted: before over after, with the store as it stands; need not be unbiased.
        measured: the same, measured.
        target: of the measured ratio.
        seen: what was measured before, to begin with; added to.
        tolerance: relative distance at which to stop.
        rounds: most measurements.

    Returns:
        The ratio measured last.
    """
    seen, reached = Ratios() if seen is None else seen, math.nan
    for _ in range(rounds):
        aim = target ** (1 / seen.slope(target))
        foreseen = calibrate(store, predicted, aim, tolerance=tolerance / 4)
        reached = measured()
        seen.add(foreseen, reached)
        if abs(reached / target - 1) <= tolerance:
            break
    return reached


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
                splats, rules = (old, {}) if first else (new, now.rules)
                inputs = RasterInputs(shot.view, splats, planes=(), **rules)
                cut = None if first else thresholds(inputs)
                spent = timed(partial(engine.rasterize, inputs, cut), before.xyz.device)[1]
                least[first][index] = min(least[first][index], spent)
    return statistics.median(was / is_ for was, is_ in zip(least[True], least[False], strict=True))
