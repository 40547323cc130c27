"""Engines: implementations of one contract, rasterization with a threshold per Gaussian."""

from __future__ import annotations

import logging
from functools import cache
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from fragprune_plugins.errors import EngineError, UsageError

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from fragprune_plugins.types import (
        Moment,
        RasterInputs,
        RasterOutputs,
        Sliced,
        SpacetimeSplats,
    )

log = logging.getLogger("fragprune")

ENGINES = ("reference", "cpu", "cuda")


class Engine(Protocol):
    """What every engine does; inputs that require gradients get them."""

    name: str

    def rasterize(self, inputs: RasterInputs, thresholds: Tensor | None) -> RasterOutputs:
        """Draw the splats; thresholds is (N,) falloff in (0, 1), or None for no truncation.

        Raises:
            InputError: by ``inputs.check_thresholds``, thresholds that are not one per Gaussian.
        """


@runtime_checkable
class Slicer(Protocol):
    """What our own engines do beside."""

    def slice(self, splats: SpacetimeSplats, moment: Moment) -> Sliced:
        """Cut Gaussians in space and time at a moment; inputs that require gradients get them."""


def device_for(wanted: str = "auto", engine: str = "auto") -> torch.device:
    """The device that a command works on: the one rule behind ``--device``.

    Args:
        wanted: "cpu", "cuda", "cuda:N", or "auto": the GPU where torch sees one and our cuda
            engine may be used on it, else the CPU.
        engine: by name; ours named "cpu" and "cuda" draw on nothing else.

    Raises:
        UsageError: no such device here, or one that the engine cannot draw on.
    """
    import torch

    seen = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if wanted == "auto":
        if not seen or engine == "cpu":
            return torch.device("cpu")
        why_not = None if engine == "cuda" else _why_not_cuda("cuda")
        if why_not is None:
            return torch.device("cuda")
        log.warning("working on the CPU: %s. %s", *why_not)
        return torch.device("cpu")
    device = torch.device(wanted)
    if device.type == "cuda" and (device.index or 0) >= seen:
        raise UsageError(
            f"--device {wanted}",
            f"{seen or 'no'} CUDA device{'' if seen == 1 else 's'}",
            "that one",
            "Use --device cpu, or auto.",
        )
    if engine in ("cpu", "cuda") and device.type != engine:
        raise UsageError(
            f"--device {wanted}",
            f"--engine {engine}",
            f"--device {engine}, where it draws",
            "Leave one of the two out.",
        )
    return device


def create_engine(name: str, device: torch.device | str = "cpu") -> Engine:
    """Our own engine by name; "auto" takes the fastest that runs on the device.

    On a GPU that is the cuda engine, once it has proved itself there (``engines.cuda.self_check``);
    until then the reference engine draws small scenes, with a warning, and refuses large ones.

    Raises:
        EngineError: an unknown name, or an engine that cannot run here.
    """
    if name == "auto":
        name, why_not = _fastest(str(device))
        if why_not is not None:
            return _fallback(*why_not)
    if name == "cpu":
        from fragprune_plugins.engines.cpu.engine import CpuEngine

        return CpuEngine()
    if name == "cuda":
        from fragprune_plugins.engines.cuda.engine import CudaEngine

        return CudaEngine()
    if name == "reference":
        from fragprune_plugins.engines.reference import ReferenceEngine

        return ReferenceEngine()
    raise EngineError("engine", repr(name), f"one of auto, {', '.join(ENGINES)}", "Choose one.")


def _fastest(device: str) -> tuple[str, tuple[str, str] | None]:
    """The engine's name; where it stands in for the cuda engine, why, and what to do."""
    if device.startswith("cuda"):
        why_not = _why_not_cuda(device)
        return ("reference" if why_not else "cuda"), why_not
    from fragprune_plugins.engines.cpu import binding

    return ("cpu" if device.startswith("cpu") and binding.available() else "reference"), None


def _why_not_cuda(device: str) -> tuple[str, str] | None:
    """Why the cuda engine is not to be used on a GPU, and what to do; None when it is."""
    from fragprune_plugins.engines.cuda import driver

    reason = driver.missing()
    if reason is not None:
        return f"the cuda engine cannot run: {reason}", driver.remedy()
    from fragprune_plugins.engines.cuda import self_check

    verdict = self_check.why_not(device)
    return (str(verdict), verdict.remedy) if verdict else None


@cache
def _fallback(why: str, remedy: str) -> Engine:
    """One for each reason, which is told once."""
    from fragprune_plugins.engines.reference import Fallback

    return Fallback(why, remedy)


_slicer = cache(create_engine)
"""Engines keep memory and kernels that the next frame uses again."""


def slice_at(splats: SpacetimeSplats, moment: Moment, *, engine: str | Engine = "auto") -> Sliced:
    """The 3D Gaussians that Gaussians in space and time are at a moment. Differentiable.

    Gradients are those of RT-4DGS, whose kernels differentiate by hand: without ``rotations_r`` the
    marginal has none; colours are differentiated as seen where the moment has moved the means,
    though shown as seen where they are stored; where time has a say in them, the second coefficient
    gets the first one's gradient, and the times that of the highest cosine alone, with the opposite
    sign.

    Args:
        splats: the Gaussians.
        moment: when and from where.
        engine: a name as ``create_engine`` takes it, or an engine; one that is not ours and cuts
            nothing leaves it to the fastest of ours on the device.

    Raises:
        InputError: harmonics with fewer coefficients than the moment's cosines take.
        EngineError: no such engine here.
    """
    if isinstance(engine, Slicer):
        return engine.slice(splats, moment)
    if not isinstance(engine, str) or engine == "auto":
        engine, _ = _fastest(str(splats.device))
    slicer: Slicer = _slicer(engine)  # type: ignore[assignment]
    return slicer.slice(splats, moment)
