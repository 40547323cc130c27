"""How values that hold tensors are shown: on one line, with shapes and types."""

from __future__ import annotations

from dataclasses import fields
from typing import Any


def one_line(thing: Any) -> str:
    """The ``__repr__`` of a dataclass with tensors; fields that are None are left out."""
    held = {each.name: getattr(thing, each.name) for each in fields(thing)}
    inside = [f"{name}={short(value)}" for name, value in held.items() if value is not None]
    return f"{type(thing).__name__}({', '.join(inside)})"


def short(value: Any) -> str:
    """A tensor as ``float32[9, 3]``, with its device unless it is the CPU; a list as its length.

    Of a tensor that holds one number without an axis, that number.
    """
    if getattr(value, "ndim", None) == 0:
        return f"{float(value):.6g}"
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        kind = str(value.dtype).removeprefix("torch.")
        device = str(getattr(value, "device", "cpu"))
        return f"{kind}{list(value.shape)}" + ("" if device == "cpu" else f" on {device}")
    if isinstance(value, list | tuple | dict):
        return f"[{len(value)} items]"
    return repr(value)
