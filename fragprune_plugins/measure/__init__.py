"""Measuring a splat: quality, fragments, latency, pictures."""

from fragprune_plugins.measure.evaluate import (
    Candidate,
    covered_per_pixel,
    evaluate,
    frame_times,
    measure,
)
from fragprune_plugins.measure.metrics import lpips, psnr, ssim
from fragprune_plugins.measure.visibility import drop_invisible, visible

__all__ = [
    "Candidate",
    "covered_per_pixel",
    "drop_invisible",
    "evaluate",
    "frame_times",
    "lpips",
    "measure",
    "psnr",
    "ssim",
    "visible",
]
