"""What all calls of the compiled library share: memory for their arrays, and their errors."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.errors import EngineError

if TYPE_CHECKING:
    from torch import Tensor

SMALL = 1 << 16
"""Bytes below which the C library has memory at hand itself."""


def empty(workspace: binding.Workspace, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Like torch.empty for 4-byte numbers, but large tensors reuse memory of a workspace.

    Fresh memory is slow: the system clears it page by page, which takes longer than filling it.
    """
    size = 4 * math.prod(shape)
    if size < SMALL:
        return torch.empty(shape, dtype=dtype)
    return torch.frombuffer(workspace.take(size), dtype=dtype).view(shape)


def expect_ok(status: int, error: binding.Error) -> None:
    """Raise what a call's status says.

    Raises:
        MemoryError: there is not enough memory.
        EngineError: the inputs were refused.
    """
    if status == binding.OK:
        return
    text = error.message.decode(errors="replace")
    if status == binding.OUT_OF_MEMORY:
        raise MemoryError(f"fragprune's cpu engine: {text}")
    raise EngineError(
        "engine 'cpu'", text, "inputs it can draw", "Check the camera and the Gaussians."
    )
