"""The photometric loss in compiled code, for images on a CPU."""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from fragprune_plugins.engines.calling import address, empty, expect_ok, native_threads, plain
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.errors import InputError
from fragprune_plugins.types import short

_workspace = cache(binding.Workspace)


def compiled_loss(
    image: Tensor, target: Tensor, *, ssim_weight: float, library: binding.Library | None = None
) -> Tensor:
    """(1 - ssim_weight) L1 + ssim_weight (1 - SSIM) of two images, by the compiled code.

    The same to the bit for any number of threads.

    Args:
        image: (C, H, W) float32 on a CPU, in any memory layout; differentiable, once.
        target: likewise, but a constant.
        ssim_weight: factor on 1 - SSIM, the mean over all pixels and channels as in
            ``learning.losses.ssim_map``; the mean absolute difference has the rest.
        library: the build to use; None for the best one on this machine.

    Raises:
        InputError: shape, dtype or device is another, or the target wants a gradient.
        EngineError: there is no compiled code here, or it refuses the size.
    """
    for name, tensor in (("image", image), ("target", target)):
        if tensor.device.type != "cpu" or tensor.dtype != torch.float32 or tensor.ndim != 3:
            remedy = "workbench.finetune.losses.photometric_loss takes any dtype and device."
            raise InputError(name, short(tensor), "(C, H, W) float32 on the cpu", remedy)
    if image.shape != target.shape:
        raise InputError(
            "target", short(target), f"the image's shape {tuple(image.shape)}", "Resize it."
        )
    if target.requires_grad:
        raise InputError("target", "requires_grad", "a constant", "Detach it.")
    given = binding.library() if library is None else library
    loss: Tensor = _Compiled.apply(image, target, ssim_weight, given)  # type: ignore[no-untyped-call]
    return loss


class _Compiled(torch.autograd.Function):
    """Value and gradient in one pass."""

    @staticmethod
    def forward(
        ctx: Any, image: Tensor, target: Tensor, ssim_weight: float, library: binding.Library
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
            l1_weight=1 - ssim_weight,
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
        return x.new_tensor((1 - ssim_weight) * images.l1 + ssim_weight * images.dissimilarity)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        scaled = gradient if upstream == 1 else gradient * upstream
        return scaled, None, None, None
