"""Detect NaN and infinity in what was learned."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor

from fragprune_plugins.errors import DivergedError


def are_finite(tensors: Iterable[Tensor]) -> bool:
    """Whether all squares of all tensors add up to a finite number: False if very large, too."""
    norms = [torch.linalg.vector_norm(each.detach(), dtype=torch.float32) for each in tensors]
    return not norms or bool(torch.stack([n.to(norms[0]) for n in norms]).isfinite().all())


def not_finite(tensors: Mapping[str, Tensor]) -> list[str]:
    """The tensors that hold NaN or infinity, as a message names them: with their rows."""
    found = []
    for name, tensor in tensors.items():
        finite = tensor.detach().isfinite()
        if not finite.all():
            rows = finite.reshape(len(finite) if finite.ndim else 1, -1).all(dim=1)
            found.append(f"{name} ({int((~rows).sum())} of {len(rows)} rows)")
    return found


def expect_finite(tensors: Mapping[str, Tensor], where: str) -> None:
    """Raise DivergedError, with the rows counted, unless all tensors (N, ...) are finite."""
    if found := not_finite(tensors):
        expected = "finite numbers"
        remedy = "Nothing of it was saved. Begin again from the model before; if that one is not "
        remedy += "finite either, begin from an earlier one."
        raise DivergedError(where, f"NaN or infinity in {', '.join(found)}", expected, remedy)
