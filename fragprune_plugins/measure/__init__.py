"""Measuring a splat: quality, fragments, latency, pictures."""

from fragprune_plugins.measure.evaluate import Candidate, evaluate, measure
from fragprune_plugins.measure.metrics import lpips, psnr, ssim

__all__ = ["Candidate", "evaluate", "lpips", "measure", "psnr", "ssim"]
