"""Engines: implementations of one interface, rasterization with a threshold per Gaussian."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Protocol

from fragprune_plugins.errors import EngineError, UsageError, log

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from fragprune_plugins.types import RasterInputs, RasterOutputs

ENGINES = {
    "reference": "reference:ReferenceEngine",
    "cpu": "cpu.engine:CpuEngine",
    "cuda": "cuda.engine:CudaEngine",
}
"""Our engines: where each is, imported on use."""


class Engine(Protocol):
    """The interface of an engine. Inputs that require gradients receive them."""

    name: str

    def rasterize(self, inputs: RasterInputs, thresholds: Tensor | None) -> RasterOutputs:
        """Draw the splats; thresholds is (N,) falloff in (0, 1), or None for no truncation.

        Raises:
            InputError: there is not one threshold per Gaussian (``inputs.check_thresholds``).
        """


def device_for(wanted: str = "auto", engine: str = "auto") -> torch.device:
    """Choose the device that a command works on: the only rule behind ``--device``.

    Args:
        wanted: "cpu", "cuda", "cuda:N", or "auto": the GPU where torch sees one and our cuda
            engine may be used on it, else the CPU.
        engine: its name. Our "cpu" engine draws on the CPU alone, our "cuda" engine on a GPU alone.

    Raises:
        UsageError: the device does not exist, or the engine cannot draw on it.
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
        found = f"{seen or 'no'} CUDA device{'' if seen == 1 else 's'}"
        expected, remedy = f"{wanted}, as torch sees it", "Use --device cpu, or auto."
        raise UsageError(f"--device {wanted}", found, expected, remedy)
    if engine in ("cpu", "cuda") and device.type != engine:
        expected, remedy = f"--device {engine}, where it draws", "Leave one of the two out."
        raise UsageError(f"--device {wanted}", f"--engine {engine}", expected, remedy)
    return device


def create_engine(name: str, device: torch.device | str = "cpu") -> Engine:
    """Create one of our own engines by name; "auto" is the fastest that runs on the device.

    On a GPU that is the cuda engine, once it has passed ``engines.cuda.self_check`` there.

    Raises:
        EngineError: the name is unknown, or the engine cannot run here.
    """
    if name == "auto" and str(device).startswith("cuda"):
        if (why_not := _why_not_cuda(str(device))) is not None:
            expected = "an engine that draws on a GPU in a reasonable time"
            remedy = f"{why_not[1]} Or draw on the CPU: --device cpu. --engine reference is slow."
            raise EngineError("engine 'auto'", why_not[0], expected, remedy)
        name = "cuda"
    elif name == "auto":
        from fragprune_plugins.engines.cpu import binding

        native = str(device).startswith("cpu") and binding.available()
        name = "cpu" if native else "reference"
    if name not in ENGINES:
        expected = f"one of auto, {', '.join(ENGINES)}"
        raise EngineError("engine", repr(name), expected, "Choose one of these.")
    module, _, kind = ENGINES[name].partition(":")
    engine: Engine = getattr(import_module(f"{__name__}.{module}"), kind)()
    return engine


def _why_not_cuda(device: str) -> tuple[str, str] | None:
    """The reason not to use the cuda engine on a GPU and a remedy; None if it may be used."""
    from fragprune_plugins.engines.cuda import driver

    reason = driver.missing()
    if reason is not None:
        return f"the cuda engine cannot run: {reason}", driver.remedy()
    from fragprune_plugins.engines.cuda import self_check

    verdict = self_check.why_not(device)
    return (str(verdict), verdict.remedy) if verdict else None
