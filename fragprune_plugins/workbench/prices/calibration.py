"""Prices of this machine: frames of many sizes timed in turns, and a cost model fitted to them."""

from __future__ import annotations

import hashlib
import json
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.constants import VERSION
from fragprune_plugins.engines import Engine
from fragprune_plugins.engines.cuda.kernels import cache_folder
from fragprune_plugins.errors import CostError
from fragprune_plugins.plugins.hooks import engine_for
from fragprune_plugins.types import RasterInputs
from fragprune_plugins.workbench.figures.clock import timed
from fragprune_plugins.workbench.prices.cost import Cost, Work, fit, work_of
from fragprune_plugins.workbench.prices.machine import describe_machine
from fragprune_plugins.workbench.prices.scene import make_scene, make_view

REPEATS = 7
"""Rounds; the least of a frame's times counts, which another program's work disturbs least."""

_COUNTS = (1000, 4000, 16_000)
_SIZES = ((96, 72), (192, 144), (384, 288), (768, 576))
_FULL = (30_000, 100_000)  # as many Gaussians at their own size cover as much of the picture
_FALLOFFS = (None, 0.05, 0.15, 0.4)
_LEFT_OUT = 5  # every so many-th frame; no divisor of what is varied

Frame = tuple[dict[str, Any], RasterInputs, Tensor | None]
"""What a frame is, and what to draw."""


@dataclass(frozen=True)
class Calibration:
    """A fitted cost, and the frames that it came from.

    Attributes:
        cost: the prices.
        frames: one dict a frame: gaussians, width, height, falloff (None without truncation), ms,
            predicted_ms, left_out.
    """

    cost: Cost
    frames: Sequence[dict[str, Any]]


def frames(device: torch.device | str) -> list[Frame]:
    """Frames of the bench scene that differ in Gaussians, pixels, coverage and truncation."""
    made: list[Frame] = []
    for count in _COUNTS:
        splats = make_scene(count).to(device).splats()
        for width, height in _SIZES:
            view = make_view(width, height).to(device)
            for full in _FULL:
                inputs = RasterInputs(view, splats, scale_modifier=(full / count) ** 0.5, planes=())
                for falloff in _FALLOFFS:
                    cut = None if falloff is None else torch.full_like(splats.opacities, falloff)
                    what = {"gaussians": count, "width": width, "height": height}
                    made.append((what | {"falloff": falloff}, inputs, cut))
    return made


@torch.no_grad()
def calibrate(
    engine: Engine,
    device: torch.device | str = "cpu",
    *,
    over: Sequence[Frame] | None = None,
    repeats: int = REPEATS,
    say: Callable[[str], None] = lambda _: None,
) -> Calibration:
    """Time frames in turns and fit prices to four fifths of them; the others tell the error.

    Args:
        engine: what to time.
        device: where the work is done.
        over: the frames; those of ``frames`` when None.
        repeats: rounds after one to warm up.
        say: called with a line of text after each finished round.

    Raises:
        CostError: the engine does not count its lists.
    """
    device = torch.device(device)
    over = frames(device) if over is None else over
    works: list[Work] = []
    for _, inputs, cut in over:
        works.append(work_of(engine.rasterize(inputs, cut)))
    if any(count != count for work in works for count in work.values()):
        raise CostError(
            f"engine {engine.name!r}",
            "no count of list entries",
            "an engine that counts them",
            "Use --engine cpu or cuda.",
        )
    least = [float("inf")] * len(over)
    for turn in range(repeats):
        order = range(len(over)) if turn % 2 == 0 else reversed(range(len(over)))
        for index in order:
            _, inputs, cut = over[index]
            spent = timed(lambda: engine.rasterize(inputs, cut), device)[1]  # noqa: B023
            least[index] = min(least[index], spent)
        say(f"round {turn + 1} of {repeats}")
    outside = [index % _LEFT_OUT == _LEFT_OUT - 1 for index in range(len(over))]
    pairs = list(zip(works, least, outside, strict=True))
    inside = [(work, ms) for work, ms, out in pairs if not out]
    prices = fit([work for work, _ in inside], [ms for _, ms in inside])
    cost = Cost(prices)
    errors = [abs(cost.ms(work) / ms - 1) for work, ms, out in pairs if out]
    cost = Cost(
        prices, statistics.median(errors) if errors else float("nan"), machine(engine, device)
    )
    rows = [
        what | {"ms": ms, "predicted_ms": cost.ms(work), "left_out": out}
        for (what, _, _), (work, ms, out) in zip(over, pairs, strict=True)
    ]
    return Calibration(cost, rows)


def machine(engine: Engine, device: torch.device | str) -> dict[str, Any]:
    """What prices depend on: engine, processor or GPU, the engine's build, threads, version."""
    found = describe_machine(device)
    return {
        "engine": engine.name,
        "processor": found["gpu"] or found["processor"],
        "native": found["native"],
        "threads": torch.get_num_threads(),
        "version": VERSION,
    }


def kept_at(engine: Engine, device: torch.device | str) -> Path:
    """Where prices of this engine on this machine are kept: beside compiled kernels."""
    known = json.dumps(machine(engine, device), sort_keys=True).encode()
    digest = hashlib.sha256(known).hexdigest()[:12]
    return cache_folder() / f"prices-{engine.name}-{digest}.json"


def prices_of(
    engine: str | Engine = "auto",
    device: torch.device | str = "cpu",
    *,
    say: Callable[[str], None] | None = None,
) -> Cost:
    """The kept prices of this machine; measured and kept where there are none.

    Args:
        engine: a name or an engine.
        device: where it draws.
        say: called with a line of text before prices are measured.

    Raises:
        CostError: the kept file is malformed, or the engine does not count its lists.
        OutputError: they cannot be kept.
    """
    if isinstance(engine, str):
        engine = engine_for(engine, device)
    path = kept_at(engine, device)
    if path.exists():
        return Cost.load(path)
    if say is not None:
        say("Measuring what a frame costs here, once; fragprune bench --calibrate measures anew.")
    cost = calibrate(engine, device).cost
    cost.save(path)
    return cost
