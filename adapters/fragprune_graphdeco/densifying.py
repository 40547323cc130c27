"""Computes the rows that densify methods will copy: the ``how`` of PARENTS seams."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from fragprune_plugins.adapting import SeamCall

if TYPE_CHECKING:
    from torch import Tensor

Needy = Callable[[Mapping[str, Any], int, Callable[..., "Tensor"]], "Tensor"]
"""What ``needy`` is, for hosts that ask otherwise."""


def needy(arguments: Mapping[str, Any], rows: int, flat: Callable[..., Tensor]) -> Tensor:
    """(rows,) bool: rows to copy by their gradient; ``flat`` reduces (n, 1) as the method does."""
    return reaches(flat(arguments["grads"], dim=-1), arguments["grad_threshold"], rows)


def reaches(grads: Tensor, threshold: Any, rows: int) -> Tensor:
    """(rows,) bool: gradients (n,) at or above the threshold; rows just appended have none."""
    padded = grads.new_zeros(rows)
    padded[: len(grads)] = grads
    reached: Tensor = padded >= threshold
    return reached


def clones(call: SeamCall, needy: Needy = needy) -> Tensor:
    """Rows (n,) that densify_and_clone copies: small Gaussians with a large gradient."""
    import torch

    size, limit = _sizes(call)
    rows: Tensor = (needy(call.arguments, len(size), torch.norm) & (size <= limit)).nonzero()[:, 0]
    return rows


def splits(call: SeamCall, needy: Needy = needy, copies: int | None = None) -> Tensor:
    """Rows (n,) that densify_and_split copies N times: large Gaussians with a large gradient."""
    import torch

    size, limit = _sizes(call)
    chosen = needy(call.arguments, len(size), torch.squeeze) & (size > limit)
    rows: Tensor = chosen.nonzero()[:, 0]
    return rows.repeat(call.arguments["N"] if copies is None else copies)


def _sizes(call: SeamCall) -> tuple[Tensor, float]:
    """Every Gaussian's largest scale, and the limit between small and large."""
    size: Tensor = call.model.get_scaling.detach().max(dim=1).values
    return size, call.model.percent_dense * call.arguments["scene_extent"]
