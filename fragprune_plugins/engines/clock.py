"""Wall-clock time of a frame, the work that a GPU still has to do included."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

import torch

Made = TypeVar("Made")


def synchronize(device: torch.device) -> None:
    """Wait until a device has done all that it was told; a CPU has."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def timed(work: Callable[[], Made], device: torch.device) -> tuple[Made, float]:
    """What work gives, and the milliseconds from an idle device to an idle device."""
    synchronize(device)
    started = time.perf_counter()
    made = work()
    synchronize(device)
    return made, 1e3 * (time.perf_counter() - started)
