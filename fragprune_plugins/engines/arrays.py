"""Tensors in the form that compiled code reads: contiguous, on one device, by address."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from torch import Tensor


def plain(
    tensor: Tensor, where: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
) -> Tensor:
    """The tensor's values, contiguous on a device, as 4-byte numbers."""
    return tensor.detach().to(where, dtype).contiguous()


def address(tensor: Tensor | None) -> int | None:
    """The address of a tensor's first number; None for no tensor or an empty one."""
    return None if tensor is None or tensor.numel() == 0 else tensor.data_ptr()
