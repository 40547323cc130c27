"""Wall-clock times of frames, including work that is still queued on a GPU."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from typing import TypeVar

import torch

Made = TypeVar("Made")


def standard_error(values: Sequence[float]) -> float:
    """Of the mean of values; 0 for a single one."""
    return statistics.stdev(values) / len(values) ** 0.5 if len(values) > 1 else 0.0


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
