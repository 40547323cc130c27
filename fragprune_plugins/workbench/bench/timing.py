"""Timing rasterizers side by side: rounds in turns, pictures compared, peak memory."""

from __future__ import annotations

import os
import platform
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.plugins.hooks import drawn_by
from fragprune_plugins.types import RasterInputs, RasterOutputs, Splats, View, one_line
from fragprune_plugins.workbench.bench.scene import make_scene, make_view
from fragprune_plugins.workbench.figures.clock import standard_error, synchronize, timed

Pass = Literal["forward", "forward_backward"]
PASSES: tuple[Pass, ...] = get_args(Pass)

TRUNCATION = 16 / 255
"""Threshold of all Gaussians in truncated rows; leaves 0.63 of the fragments, as learning does."""


@dataclass(frozen=True)
class Case:
    """A rasterization to time."""

    scene: str
    view: View  # on the Gaussians' device, which does the work
    splats: Splats
    kind: Pass
    thresholds: Tensor | None = None
    rules: Mapping[str, Any] = field(default_factory=dict)
    """``Model.rules`` to draw by."""

    __repr__ = one_line

    @property
    def device(self) -> torch.device:
        """Where the Gaussians are."""
        return self.splats.device


def cases(
    scene: str, view: View, splats: Splats, cut: Tensor, rules: Mapping[str, Any]
) -> list[Case]:
    """Both passes of a scene, each without truncation, and then with thresholds (N,) and rules."""
    plain = [Case(scene, view, splats, kind) for kind in PASSES]
    return [each for case in plain for each in (case, replace(case, thresholds=cut, rules=rules))]


def generated(count: int, size: tuple[int, int], device: torch.device | str) -> list[Case]:
    """The cases of the bench scene with so many Gaussians, at a size."""
    splats, view = make_scene(count).to(device).splats(), make_view(*size).to(device)
    cut = torch.full_like(splats.opacities, TRUNCATION)
    return cases(f"bench-{count}", view, splats, cut, {})


def measure(
    cases: Sequence[Case],
    engines: Sequence[Engine],
    *,
    repeats: int = 9,
    say: Callable[[str], None] = lambda _: None,
) -> list[dict[str, Any]]:
    """Time every case on every engine, all of them once a round.

    On a GPU the clock stops when it is idle again, after the backward pass too.

    Args:
        engines: pictures are compared with those of the first one.
        repeats: number of rounds after one warm-up round.

    Returns:
        One dict a case and engine; with stages (medians in ms), ns_per_fragment (of the median;
        None where nothing is drawn), peak_mb (beyond inputs, of a GPU's own memory as torch gives
        it out, else of main memory; None where the system cannot tell), difference (mean absolute,
        from the first engine's picture).
    """
    jobs = [(case, engine, _prepare(case, engine)) for case in cases for engine in engines]
    times: list[list[float]] = [[] for _ in jobs]
    stages: list[list[dict[str, float]]] = [[] for _ in jobs]
    first = [_with_peak(job, case.device) for case, _, job in jobs]
    for turn in range(repeats):
        order = range(len(jobs)) if turn % 2 == 0 else reversed(range(len(jobs)))
        for index in order:
            case, _, job = jobs[index]
            outputs, spent = timed(job, case.device)
            times[index].append(spent)
            parts = dict(outputs.stages or {})
            if case.kind == "forward_backward" and parts:
                parts["backward"] = spent - sum(parts.values())
            stages[index].append(parts)
        say(f"round {turn + 1} of {repeats}")
    results = []
    for index, (case, engine, _) in enumerate(jobs):
        outputs, peak = first[index]
        compared, _ = first[index - index % len(engines)]
        median = statistics.median(times[index])
        drawn = float(outputs.fragments_per_pixel.detach())
        fragments = drawn * case.view.width * case.view.height
        results.append(
            {
                "scene": case.scene,
                "width": case.view.width,
                "height": case.view.height,
                "gaussians": len(case.splats),
                "pass": case.kind,
                "engine": engine.name,
                "device": str(case.device),
                "threads": torch.get_num_threads(),
                "truncated": case.thresholds is not None,
                "fragments_per_pixel": drawn,
                "evaluated_per_pixel": outputs.evaluated_per_pixel,
                "ms_median": median,
                "ms_min": min(times[index]),
                "ms_se": standard_error(times[index]),
                "ns_per_fragment": 1e6 * median / fragments if fragments else None,
                "stages": {
                    name: statistics.median(part[name] for part in stages[index])
                    for name in stages[index][0]
                },
                "peak_mb": peak,
                "difference": float((outputs.image - compared.image).detach().abs().mean()),
            }
        )
    return results


def _prepare(case: Case, engine: Engine) -> Callable[[], RasterOutputs]:
    """Make a function that draws once, optionally with gradients of a fixed random loss."""
    inputs = RasterInputs(case.view, case.splats, planes=(), **case.rules)
    if case.kind == "forward":
        return torch.no_grad()(partial(drawn_by, engine, inputs, case.thresholds))
    names = ("means", "opacities", "scales", "rotations", "sh")
    leaves = {n: getattr(case.splats, n).detach().clone().requires_grad_(True) for n in names}
    hook = torch.zeros(len(case.splats), 3, device=case.device, requires_grad=True)
    thresholds = None
    if case.thresholds is not None:
        thresholds = case.thresholds.clone().requires_grad_(True)
    splats = replace(case.splats, **leaves)
    inputs = RasterInputs(case.view, splats, hook, planes=(), **case.rules)
    stream = torch.Generator().manual_seed(0)
    weight = torch.randn(3, case.view.height, case.view.width, generator=stream).to(case.device)

    def draw_and_differentiate() -> RasterOutputs:
        for leaf in (*leaves.values(), hook, *([] if thresholds is None else [thresholds])):
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
        before = _status("VmRSS")
        outputs = job()
        return outputs, max(0.0, _status("VmHWM") - before)
    except OSError:
        return job(), None


def _status(field: str) -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field):
            return float(line.split()[1]) / 1024
    raise OSError(f"no {field} in /proc/self/status")


def describe_machine(device: torch.device | str = "cpu") -> dict[str, Any]:
    """The processor, and the versions that decide about speed."""
    device = torch.device(device)
    native = binding.chosen()
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "platform": platform.platform(),
        "torch": torch.__version__,
        "native": native.build if isinstance(native, binding.Library) else None,  # cpu engine
        "gpu": torch.cuda.get_device_name(device) if device.type == "cuda" else None,
    }


def load_average() -> float | None:
    """Processes that run or wait, mean over a minute; None where the system does not tell."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
