"""The photometric loss by the fastest code that is here for where the images are."""

from __future__ import annotations

import ctypes
import importlib.util
from functools import cache
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch.autograd.function import once_differentiable

from fragprune_plugins.engines.calling import address, empty, expect_ok, native_threads, plain
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.errors import InputError
from fragprune_plugins.learning import losses
from fragprune_plugins.learning.losses import SSIM_WEIGHT
from fragprune_plugins.types import short

if TYPE_CHECKING:
    from torch import Tensor

Code = Literal["cpu", "fused-ssim", "torch"]
"""Who computes a loss. Results differ in their last bits."""

_workspace = cache(binding.Workspace)


def code_for(device: torch.device) -> Code:
    """Who computes the loss of float32 images on a device."""
    if device.type == "cpu" and binding.available():
        return "cpu"
    if device.type == "cuda" and importlib.util.find_spec("fused_ssim") is not None:
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
        return compiled_loss(image, target)
    if code == "fused-ssim":
        from fused_ssim import fused_ssim

        ssim: Tensor = fused_ssim(image[None], target[None])
        return (1 - SSIM_WEIGHT) * losses.l1(image, target) + SSIM_WEIGHT * (1 - ssim)
    return losses.photometric_loss(image, target)


def compiled_loss(
    image: Tensor,
    target: Tensor,
    *,
    l1_weight: float = 1 - SSIM_WEIGHT,
    ssim_weight: float = SSIM_WEIGHT,
    library: binding.Library | None = None,
) -> Tensor:
    """l1_weight L1 + ssim_weight (1 - SSIM) of two images, by the compiled code.

    The same to the bit for any number of threads.

    Args:
        image: (C, H, W) float32 on a CPU, in any memory layout; differentiable, once.
        target: likewise, but a constant.
        l1_weight: factor on the mean absolute difference.
        ssim_weight: factor on 1 - SSIM, the mean over all pixels and channels as in
            ``learning.losses.ssim``.
        library: the build to use; None for the best one on this machine.

    Raises:
        InputError: shape, dtype or device is another, or the target wants a gradient.
        EngineError: there is no compiled code here, or it refuses the size.
    """
    for name, tensor in (("image", image), ("target", target)):
        if tensor.device.type != "cpu" or tensor.dtype != torch.float32 or tensor.ndim != 3:
            remedy = "learning.losses.photometric_loss takes any dtype and device."
            raise InputError(name, short(tensor), "(C, H, W) float32 on the cpu", remedy)
    if image.shape != target.shape:
        raise InputError(
            "target", short(target), f"the image's shape {tuple(image.shape)}", "Resize it."
        )
    if target.requires_grad:
        raise InputError("target", "requires_grad", "a constant", "Detach it.")
    given = binding.library() if library is None else library
    loss: Tensor = _Compiled.apply(image, target, l1_weight, ssim_weight, given)  # type: ignore[no-untyped-call]
    return loss


class _Compiled(torch.autograd.Function):
    """Value and gradient in one pass."""

    @staticmethod
    def forward(
        ctx: Any,
        image: Tensor,
        target: Tensor,
        l1_weight: float,
        ssim_weight: float,
        library: binding.Library,
    ) -> Tensor:
        x, y = plain(image), plain(target)
        channels, height, width = x.shape
        workspace = _workspace(library)
        gradient = empty(workspace, *x.shape) if ctx.needs_input_grad[0] else None
        images = binding.Photometric(
            threads=native_threads(),
            channels=channels,
            height=height,
            width=width,
            l1_weight=l1_weight,
            ssim_weight=ssim_weight,
            image=address(x),
            target=address(y),
            gradient=address(gradient),
            workspace=workspace.handle,
        )
        error = binding.Error()
        call = library.calls.fragprune_photometric_loss
        expect_ok(call(ctypes.byref(images), ctypes.byref(error)), error)
        if gradient is not None:
            ctx.save_for_backward(gradient)
        return x.new_tensor(l1_weight * images.l1 + ssim_weight * images.dissimilarity)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        scaled = gradient if upstream == 1 else gradient * upstream
        return scaled, None, None, None, None
