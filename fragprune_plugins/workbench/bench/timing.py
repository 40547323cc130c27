"""Timing rasterizers side by side: rounds in turns, pictures compared, peak memory."""

from __future__ import annotations

import contextlib
import os
import platform
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.plugins.hooks import drawn_by
from fragprune_plugins.types import RasterInputs, RasterOutputs, one_line
from fragprune_plugins.workbench.bench.scene import make_scene, make_view
from fragprune_plugins.workbench.figures.clock import standard_error, synchronize, timed

Pass = Literal["forward", "forward_backward"]
PASSES: tuple[Pass, ...] = get_args(Pass)
TRUNCATION = 16 / 255  # of all Gaussians in truncated rows; leaves 0.63 of the fragments


@dataclass(frozen=True, eq=False)
class Case:
    """A rasterization to time, or to hold against another."""

    scene: str
    inputs: RasterInputs  # on the device that does the work
    thresholds: Tensor | None = None  # (N,), or None for no cutoffs
    kind: Pass = "forward"

    __repr__ = one_line


def cases(scene: str, inputs: RasterInputs, cut: Tensor, rules: Mapping[str, Any]) -> list[Case]:
    """Both passes of a scene, each without truncation, and then with thresholds (N,) and rules."""
    ways = ((inputs, None), (replace(inputs, **rules), cut))
    return [Case(scene, drawn, tau, kind) for kind in PASSES for drawn, tau in ways]


def generated(count: int, size: tuple[int, int], device: torch.device | str) -> list[Case]:
    """The cases of the bench scene with so many Gaussians, at a size."""
    splats, view = make_scene(count).to(device).splats(), make_view(*size).to(device)
    cut = torch.full_like(splats.opacities, TRUNCATION)
    return cases(f"bench-{count}", RasterInputs(view, splats, planes=()), cut, {})


def measure(
    cases: Sequence[Case],
    engines: Sequence[Engine],
    *,
    repeats: int = 9,
    say: Callable[[str], None] = lambda _: None,
) -> list[dict[str, Any]]:
    """Time every case on every engine, all of them once a round, after a round of warming up.

    On a GPU the clock stops when it is idle again. Returns one dict a case and engine; with stages
    (medians in ms), ns_per_fragment (of the median; None where nothing is drawn), peak_mb (beyond
    inputs, of a GPU's own memory as torch gives it out, else of main memory; None where the system
    cannot tell), difference (mean absolute, from the first engine's picture).
    """
    jobs = [_Job(case, engine) for case in cases for engine in engines]
    for turn in range(repeats):
        for job in jobs if turn % 2 == 0 else reversed(jobs):
            job.time()
        say(f"round {turn + 1} of {repeats}")
    pairs = zip(jobs, (first for first in jobs[:: len(engines)] for _ in engines), strict=True)
    return [job.result(first.outputs.image) for job, first in pairs]


class _Job:
    """A case on an engine; construction draws it once, which warms up and finds the peak memory."""

    def __init__(self, case: Case, engine: Engine) -> None:
        self.case, self.engine, self.draw = case, engine, _prepare(case, engine)
        self.times: list[float] = []
        self.stages: list[dict[str, float]] = []
        self.device = case.inputs.splats.device
        self.outputs, self.peak = _with_peak(self.draw, self.device)

    def time(self) -> None:
        """Draw once more, by the clock."""
        outputs, spent = timed(self.draw, self.device)
        parts = dict(outputs.stages or {})
        if self.case.kind == "forward_backward" and parts:
            parts["backward"] = spent - sum(parts.values())
        self.times.append(spent)
        self.stages.append(parts)

    def result(self, compared: Tensor) -> dict[str, Any]:
        """The figures, with the difference from another picture."""
        case, outputs, median = self.case, self.outputs, statistics.median(self.times)
        view = case.inputs.view
        drawn = float(outputs.fragments_per_pixel.detach())
        fragments = drawn * view.width * view.height
        names = self.stages[0]
        return {
            "scene": case.scene,
            "width": view.width,
            "height": view.height,
            "gaussians": len(case.inputs.splats),
            "pass": case.kind,
            "engine": self.engine.name,
            "device": str(self.device),
            "threads": torch.get_num_threads(),
            "truncated": case.thresholds is not None,
            "fragments_per_pixel": drawn,
            "evaluated_per_pixel": outputs.evaluated_per_pixel,
            "ms_median": median,
            "ms_min": min(self.times),
            "ms_se": standard_error(self.times),
            "ns_per_fragment": 1e6 * median / fragments if fragments else None,
            "stages": {n: statistics.median(part[n] for part in self.stages) for n in names},
            "peak_mb": self.peak,
            "difference": float((outputs.image - compared).detach().abs().mean()),
        }


def _prepare(case: Case, engine: Engine) -> Callable[[], RasterOutputs]:
    """Make a function that draws once, optionally with gradients of a fixed random loss."""
    inputs, cut, splats = case.inputs, case.thresholds, case.inputs.splats
    if case.kind == "forward":
        return torch.no_grad()(partial(drawn_by, engine, inputs, cut))
    names = ("means", "opacities", "scales", "rotations", "sh")
    leaves = {n: getattr(splats, n).detach().clone().requires_grad_(True) for n in names}
    hook = torch.zeros(len(splats), 3, device=splats.device, requires_grad=True)
    thresholds = None if cut is None else cut.clone().requires_grad_(True)
    inputs = replace(inputs, splats=replace(splats, **leaves), means2d_hook=hook)
    stream = torch.Generator().manual_seed(0)
    weight = torch.randn(3, inputs.view.height, inputs.view.width, generator=stream).to(hook)

    def draw_and_differentiate() -> RasterOutputs:
        for leaf in (*leaves.values(), hook, thresholds):
            if leaf is not None:
                leaf.grad = None
        outputs = drawn_by(engine, inputs, thresholds)
        torch.autograd.backward(outputs.image, weight)
        return outputs

    return draw_and_differentiate


def _with_peak(
    job: Callable[[], RasterOutputs], device: torch.device
) -> tuple[RasterOutputs, float | None]:
    """Run once, which also warms up; returns the peak memory above the start, in MB."""
    if device.type == "cuda":
        synchronize(device)
        torch.cuda.reset_peak_memory_stats(device)
        start = torch.cuda.memory_allocated(device)
        outputs = job()
        return outputs, (torch.cuda.max_memory_allocated(device) - start) / 2**20
    try:
        Path("/proc/self/clear_refs").write_text("5")  # Linux: forget the old peak
        before = _kilobytes("VmRSS")
        outputs = job()
        return outputs, max(0.0, _kilobytes("VmHWM") - before) / 1024
    except OSError:
        return job(), None


def _kilobytes(name: str) -> float:
    return float(_told("/proc/self/status", name).split()[0])


def _told(path: str, name: str) -> str:
    """What a file such as /proc/cpuinfo first says behind a name; OSError if it does not."""
    for line in Path(path).read_text().splitlines():
        key, _, value = line.partition(":")
        if key.strip() == name:
            return value.strip()
    raise OSError(f"no {name} in {path}")


def describe_machine(device: torch.device | str = "cpu") -> dict[str, Any]:
    """The processor, and the versions that decide about speed."""
    device = torch.device(device)
    native, processor = binding.chosen(), platform.processor() or platform.machine()
    with contextlib.suppress(OSError):
        processor = _told("/proc/cpuinfo", "model name")
    return {
        "processor": processor,
        "cores": os.cpu_count(),
        "platform": platform.platform(),
        "torch": torch.__version__,
        "native": native.build if isinstance(native, binding.Library) else None,  # cpu engine
        "gpu": torch.cuda.get_device_name(device) if device.type == "cuda" else None,
    }


def load_average() -> float | None:
    """Processes that run or wait, mean over a minute; None where the system does not tell."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None
