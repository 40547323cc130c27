"""Wall-clock time of a frame, including work that is still queued on a GPU."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

import torch

Made = TypeVar("Made")


def synchronize(device: torch.device) -> None:
    """Wait until a device has finished its queued work; a CPU has none."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def timed(work: Callable[[], Made], device: torch.device) -> tuple[Made, float]:
    """Run ``work``; returns its result and the milliseconds from idle device to idle device."""
    synchronize(device)
    started = time.perf_counter()
    made = work()
    synchronize(device)
    return made, 1e3 * (time.perf_counter() - started)
