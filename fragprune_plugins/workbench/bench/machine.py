"""What times were taken on."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any

import torch

from fragprune_plugins.engines.cpu import binding


def describe_machine(device: torch.device | str = "cpu") -> dict[str, Any]:
    """The processor, and the versions that decide about speed.

    Returns:
        processor, cores, platform, torch, native (build of the cpu engine, or None), gpu (name of
        the device, None for the CPU).
    """
    device = torch.device(device)
    native = binding.chosen()
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "platform": platform.platform(),
        "torch": torch.__version__,
        "native": native.build if isinstance(native, binding.Library) else None,
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
