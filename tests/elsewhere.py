"""As a GPU would have it: its matrix products, and tensors that lie there."""

from dataclasses import is_dataclass, replace
from typing import Any

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_map


class TensorFloat32(TorchFunctionMode):
    """Inside, matrices are multiplied as a GPU may: 10 bits of each factor are left (TF32)."""

    def __torch_function__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None):
        if operation.__name__ in ("matmul", "__matmul__", "mm", "bmm", "einsum"):
            args = tree_map(_ten_bits, args)
        return operation(*args, **(kwargs or {}))


def _ten_bits(value: Any) -> Any:
    if not isinstance(value, torch.Tensor) or value.dtype is not torch.float32:
        return value
    return (value.detach().contiguous().view(torch.int32) & -(1 << 13)).view(torch.float32)


def moved(value: Any, device: torch.device | str) -> Any:
    """Nested dataclasses with all tensors on a device; differentiable."""
    if isinstance(value, torch.Tensor):
        return value.to(device)
    if not is_dataclass(value):
        return value
    return replace(value, **{key: moved(part, device) for key, part in vars(value).items()})
