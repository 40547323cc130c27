"""A device that is none: its tensors say that they are elsewhere, and hold numbers all the same.

Stands for a GPU where there is none. As on one, an operation refuses tensors of two devices, and
NumPy cannot see the numbers. What is proved is where tensors are, not that a GPU likes them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass, replace
from typing import Any

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

from fragprune_plugins.engines import create_engine
from fragprune_plugins.plugins.hookspecs import hookimpl

DEVICE = torch.device("meta")
"""Of all devices that torch knows without a driver, the one whose gradients it can follow."""

_MOVES = (torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default)


class Elsewhere(torch.Tensor):
    """Wraps the numbers."""

    is_meta = False  # its numbers are there, and only the device of its name has none

    @staticmethod
    def __new__(cls, numbers: torch.Tensor) -> Elsewhere:
        return torch.Tensor._make_wrapper_subclass(
            cls, numbers.shape, numbers.stride(), dtype=numbers.dtype, device=DEVICE
        )

    def __init__(self, numbers: torch.Tensor) -> None:
        self.numbers = numbers

    @classmethod
    def __torch_dispatch__(cls, operation: Any, types: Any, args: Any = (), kwargs: Any = None):
        return _run(operation, args, kwargs or {})


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


class _Everything(TorchDispatchMode):
    """Sees operations that create or move tensors as well."""

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None):
        return _run(operation, args, kwargs or {})


def _run(operation: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    given = [each for each in tree_flatten((args, kwargs))[0] if isinstance(each, torch.Tensor)]
    away = [isinstance(each, Elsewhere) for each in given]
    if any(away) and operation not in _MOVES:
        strangers = [x for x, is_away in zip(given, away, strict=True) if not is_away and x.ndim]
        if strangers:
            raise RuntimeError(f"{operation}: tensors on two devices")
    wanted = kwargs.get("device")
    if operation is torch.ops.aten.copy_.default:
        leaves = away[0]
    elif wanted is not None:
        leaves = torch.device(wanted) == DEVICE
        kwargs = {**kwargs, "device": "cpu"}
    else:
        leaves = any(away)
    made = operation(*tree_map(_numbers, args), **tree_map(_numbers, kwargs))
    for each in given:
        if _numbers(each) is made:  # in place
            return each
    return tree_map(_wrapped, made) if leaves else made


def _numbers(value: Any) -> Any:
    return value.numbers if isinstance(value, Elsewhere) else value


def _wrapped(value: Any) -> Any:
    return Elsewhere(value) if isinstance(value, torch.Tensor) else value


@contextmanager
def there() -> Iterator[None]:
    """Inside, tensors can be moved to ``DEVICE`` and back."""
    with _Everything():
        yield


def tensors(value: Any, name: str = "") -> dict[str, torch.Tensor]:
    """All tensors of nested dataclasses, by name."""
    if isinstance(value, torch.Tensor):
        return {name: value}
    if not is_dataclass(value):
        return {}
    parts = (tensors(part, f"{name}.{key}") for key, part in vars(value).items())
    return {key: tensor for part in parts for key, tensor in part.items()}


def moved(value: Any, device: torch.device | str) -> Any:
    """Nested dataclasses with all tensors on a device; differentiable."""
    if isinstance(value, torch.Tensor):
        return value.to(device)
    if not is_dataclass(value):
        return value
    return replace(value, **{key: moved(part, device) for key, part in vars(value).items()})


class Engine:
    """Draws only what is wholly elsewhere, and counts frames."""

    name = "elsewhere"

    def __init__(self) -> None:
        self.frames = 0
        self._inner = create_engine("auto")

    def rasterize(self, inputs: Any, thresholds: torch.Tensor | None) -> Any:
        """Refuses tensors that are here."""
        found = tensors(inputs) | tensors(thresholds, "thresholds")
        here = [name for name, tensor in found.items() if not isinstance(tensor, Elsewhere)]
        assert not here, f"not on the device: {here}"
        self.frames += 1
        outputs = self._inner.rasterize(moved(inputs, "cpu"), moved(thresholds, "cpu"))
        return moved(outputs, DEVICE)

    @hookimpl
    def fragprune_create_engine(self, name: str, device: torch.device) -> Engine:
        """Itself, for whatever is asked."""
        assert device == DEVICE
        return self
