"""The photometric loss by the fastest code that is here for where the images are."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Literal

import torch
from torch import Tensor

from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.engines.losses import compiled_loss
from fragprune_plugins.learning.losses import SSIM_WEIGHT, ssim_map


def code_for(device: torch.device) -> Literal["cpu", "fused-ssim", "torch"]:
    """Who computes the loss of float32 images on a device. Results differ in their last bits."""
    if device.type == "cpu" and binding.available():
        return "cpu"
    if device.type == "cuda" and find_spec("fused_ssim") is not None:
        return "fused-ssim"
    return "torch"


def photometric_loss(image: Tensor, target: Tensor) -> Tensor:
    """0.8 L1 + 0.2 (1 - SSIM) of two images (C, H, W); differentiable.

    The compiled code and fused-ssim take float32 images, and give a gradient by the first alone;
    torch does what they do not.
    """
    usual = image.dtype == target.dtype == torch.float32 and not target.requires_grad
    code = code_for(image.device) if usual and image.device == target.device else "torch"
    if code == "cpu":
        return compiled_loss(image, target, ssim_weight=SSIM_WEIGHT)
    if code == "fused-ssim":
        from fused_ssim import fused_ssim

        similar: Tensor = fused_ssim(image[None], target[None])
    else:
        similar = ssim_map(image, target).mean()
    return (1 - SSIM_WEIGHT) * (image - target).abs().mean() + SSIM_WEIGHT * (1 - similar)
