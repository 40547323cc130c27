"""Whether what was learned is numbers at all."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from fragprune_plugins.errors import DivergedError

if TYPE_CHECKING:
    from torch import Tensor

CHECK_EVERY = 100
"""Steps between two looks at every trained number: each look waits for the device."""


def expect_finite(tensors: Mapping[str, Tensor], where: str) -> None:
    """Raise DivergedError unless every number of every tensor is finite; rows are counted.

    Args:
        tensors: (N, ...), by what to call them.
        where: which training, and which step of it.
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
            "Nothing of it was saved. Begin again from the model before; if that is not finite "
            "either, from an earlier one.",
        )
