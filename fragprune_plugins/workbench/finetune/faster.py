"""A target in frame times: thresholds change fragments, and the clock has the last word."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import UsageError
from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.stage2 import evenly_spaced
from fragprune_plugins.learning.targets import FEWEST, Target, calibrate
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.workbench.figures.evaluate import Candidate, rounds
from fragprune_plugins.workbench.goals import TIME_FOLLOWS
from fragprune_plugins.workbench.scenes.dataset import Shot

CLOCKED_AT = (0.25, 0.45, 0.65)
"""Shares of the learning at which frames are timed, to steer by."""

LIMIT_VIEWS = 4
"""Training views on which the shortest frame time is measured, before any learning."""

_ROUNDS, _SECONDS = 7, 1.5  # at least
_NEAR = 0.02  # a share by which frame times are noisy
_MEASURED = 5  # times at most, to meet a target


class FrameTarget(Target):
    """Meets a ratio of frame times: of the untruncated model as it came in, over the truncated.

    Args:
        training: whose model is timed.
    """

    figure: ClassVar[str] = "faster"

    def __init__(self, ratio: float, training: Any = None) -> None:
        super().__init__(ratio)
        self.training = training
        self.seen: list[tuple[float, float]] = []  # logarithms of fragments' ratios, and of times'
        self.timed = 0  # of CLOCKED_AT

    def measure(self, views: Sequence[Any]) -> float:
        """How many times as fast frames of these views are now."""
        start, now = self.training.start.untruncated(), self.training.result_model()
        return times_faster(Candidate(start), Candidate(now), views, self.training.engine)

    def followed(self, fragments: float) -> float:
        """The ratio of frame times that a ratio of fragments brings, by what was timed so far."""
        return float(fragments ** self.slope())

    def look(self, progress: float, ratio: Callable[[], float], views: Sequence[Any]) -> None:
        """Time frames, at some shares of the learning."""
        passed = sum(progress >= share for share in CLOCKED_AT)
        if self.timed < passed:
            self.timed = passed
            self.note(ratio(), self.measure(views))

    def meet(self, store: ThresholdStore, ratio: Callable[[], float], views: Sequence[Any]) -> None:
        """Shift all thresholds onto the target, by predictions that measurements correct."""
        for _ in range(_MEASURED):
            aim = self.ratio ** (1 / self.slope())
            fragments = calibrate(store, ratio, aim, tolerance=_NEAR / 4)
            self.met = self.measure(views)
            self.note(fragments, self.met)
            if abs(self.met / self.ratio - 1) <= _NEAR:
                break

    def state(self) -> dict[str, Any]:
        """Also what was timed."""
        return super().state() | {"seen": list(self.seen), "timed": self.timed}

    def note(self, fragments: float, measured: float) -> None:
        """Take a pair of ratios in, unless it is too near 1 to tell a slope from noise."""
        if 1 + _NEAR < fragments < math.inf and measured > 1 + _NEAR:
            self.seen.append((math.log(fragments), math.log(measured)))

    def slope(self) -> float:
        """ln(frame times) / ln(fragments) near the target, 0.1 to 1.5; a rough one at first.

        Both ratios are 1 without truncation, so that their logarithms are taken as proportional.
        The slope is fitted to all, in which noise cancels; those near the target weigh most.
        """
        weights = [1 / (_NEAR**2 + (m - math.log(self.ratio)) ** 2) for _, m in self.seen]
        squares = sum(w * p * p for w, (p, _) in zip(weights, self.seen, strict=True))
        if squares == 0:
            return TIME_FOLLOWS
        products = sum(w * p * m for w, (p, m) in zip(weights, self.seen, strict=True))
        return min(max(products / squares, 0.1), 1.5)


@torch.no_grad()
def require_reach(target: float, model: Model, shots: Sequence[Shot], engine: Engine) -> None:
    """Refuse a ratio that thresholds cannot reach, because pixels and Gaussians stay.

    UsageError says so where frames with so few fragments as no target leaves take longer.
    """
    some, plain = evenly_spaced(shots, LIMIT_VIEWS), Candidate(model.untruncated())
    store = ThresholdStore.from_falloff(torch.full_like(plain.splats.opacities, 0.05))
    inputs = [plain.inputs(shot.view) for shot in some]

    def drawn(cut: Tensor | None) -> float:
        return sum(float(engine.rasterize(each, cut).fragments_per_pixel) for each in inputs)

    before = drawn(None)
    calibrate(store, lambda: before / max(drawn(store.values), 1e-9), FEWEST, tolerance=0.1)
    limit = times_faster(plain, plain.sharing(cut=store.values), some, engine)
    if target >= limit:
        size = f"{shots[0].view.width}x{shots[0].view.height}"
        raise UsageError(
            "target time",
            f"{target:g}x as fast",
            f"less than {limit:.2f}x: pixels and Gaussians take the rest of a frame at {size}",
            "Lower --target-time, or remove Gaussians first.",
        )


@torch.no_grad()
def times_faster(before: Candidate, now: Candidate, shots: Sequence[Shot], engine: Engine) -> float:
    """Frame time of a model over that of another.

    The median over views of the ratio of their least times: a view that another program disturbed
    in all rounds moves it little.
    """
    started, least = time.perf_counter(), torch.full((2, len(shots)), math.inf).double()
    for turn, found in enumerate(rounds([before, now], [shot.view for shot in shots], engine), 1):
        least = least.minimum(torch.tensor(found).to(least))
        if turn >= _ROUNDS and time.perf_counter() - started >= _SECONDS:
            break
    return float(statistics.median((least[0] / least[1]).tolist()))
