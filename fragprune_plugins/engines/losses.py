"""The photometric loss in compiled code, for images on a CPU."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor

from fragprune_plugins.engines.calling import Wanted, empty, in_graph, native_threads, plain, run
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.errors import InputError
from fragprune_plugins.types import short

_workspace = cache(binding.Workspace)


def compiled_loss(
    image: Tensor, target: Tensor, *, ssim_weight: float, library: binding.Library | None = None
) -> Tensor:
    """(1 - ssim_weight) L1 + ssim_weight (1 - SSIM) of two images, by the compiled code.

    The same to the bit for any number of threads. SSIM is the mean over all pixels and channels of
    ``learning.losses.ssim_map``.

    Args:
        image: (C, H, W) float32 on a CPU, in any memory layout; differentiable, once.
        target: likewise, but a constant.
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
        expected = f"the image's shape {tuple(image.shape)}"
        raise InputError("target", short(target), expected, "Resize it.")
    if target.requires_grad:
        raise InputError("target", "requires_grad", "a constant", "Detach it.")
    opened = binding.library() if library is None else library
    gradients: list[Tensor] = []

    def draw(wanted: Wanted) -> dict[str, Tensor]:
        """Value and gradient in one pass."""
        x, y = plain(image), plain(target)
        channels, height, width = x.shape
        workspace = _workspace(opened)
        if wanted:
            gradients.append(empty(workspace, *x.shape))
        images = binding.Photometric(
            threads=native_threads(),
            channels=channels,
            height=height,
            width=width,
            l1_weight=1 - ssim_weight,
            ssim_weight=ssim_weight,
            image=x,
            target=y,
            gradient=gradients[0] if gradients else None,
            workspace=workspace.handle,
        )
        run(opened, "photometric_loss", images)
        value = (1 - ssim_weight) * images.l1 + ssim_weight * images.dissimilarity
        return {"loss": x.new_tensor(value)}

    def undraw(wanted: Wanted, by: dict[str, Tensor]) -> dict[str, Tensor]:
        upstream = by["loss"]
        return {"image": gradients[0] if upstream == 1 else gradients[0] * upstream}

    return in_graph({"image": image}, draw, undraw, {"loss": frozenset(("image",))})["loss"]
