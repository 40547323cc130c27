"""Tensors as compiled code takes them: contiguous, in one place, by their address."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from torch import Tensor


def plain(
    tensor: Tensor, where: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
) -> Tensor:
    """The values, contiguous on a device, in four bytes each."""
    return tensor.detach().to(where, dtype).contiguous()


def address(tensor: Tensor | None) -> int | None:
    """Of its first number; None stands for no array, or for an empty one."""
    return None if tensor is None or tensor.numel() == 0 else tensor.data_ptr()
