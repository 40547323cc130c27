"""Detect NaN and infinity in what was learned."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from fragprune_plugins.errors import DivergedError

if TYPE_CHECKING:
    from torch import Tensor

CHECK_EVERY = 100
"""Number of steps between two checks of all trained numbers. A check waits for the device."""


def expect_finite(tensors: Mapping[str, Tensor], where: str) -> None:
    """Raise DivergedError unless every number of every tensor is finite; rows are counted.

    Args:
        tensors: (N, ...) each, by the name that a message gives them.
        where: the training and its step, for the message.
    """
    found = []
    for name, tensor in tensors.items():
        finite = tensor.detach().isfinite()
        if not finite.all():
            rows = finite.reshape(len(finite) if finite.ndim else 1, -1).all(dim=1)
            found.append(f"{name} ({int((~rows).sum())} of {len(rows)} rows)")
    if found:
        raise DivergedError(
            where,
            f"NaN or infinity in {', '.join(found)}",
            "finite numbers",
            "Nothing of it was saved. Begin again from the model before; if that one is not "
            "finite either, begin from an earlier one.",
        )
