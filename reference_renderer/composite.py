"""Front-to-back blending of fragments along a pixel."""

from __future__ import annotations

import torch
from torch import Tensor


def transmittances(alpha: Tensor) -> Tensor:
    """(K + 1, P) light left before each fragment of alpha (K, P), and after the last."""
    return torch.cat([alpha.new_ones(1, alpha.shape[1]), 1 - alpha]).cumprod(0)


def alive(alpha: Tensor, transmittance_min: float, stop: float | None = None) -> Tensor:
    """(K, P) bool: the pixel has not stopped at or before this fragment.

    Without a stop, a pixel stops at the first fragment that would leave less than
    transmittance_min. That fragment and all later ones are not blended. With a stop, the first
    fragment that leaves less than the stop is blended, and all later ones are not. A fragment of
    alpha 0 stops nothing.
    """
    light = transmittances(alpha.detach())
    if stop is not None:
        return light[:-1] >= stop
    return (light[1:] < transmittance_min).cumsum(0) == 0


def weights_of(alpha: Tensor) -> Tensor:
    """(K, P) alpha T of fragments in depth order, whose alpha is 0 where not drawn or stopped."""
    return alpha * transmittances(alpha)[:-1]


def composed(alpha: Tensor, stop: float | None) -> tuple[Tensor, Tensor]:
    """Weights (K, P) of alpha (K, P), and the light (1, P) that is left behind the last fragment.

    Nobody sees what a pixel leaves out behind its stop. Its gradients take it to look like the last
    fragment: they are those of a pixel whose last fragment is opaque. Else they would see the
    background there, and make each fragment more opaque that looks better than that.
    """
    weights, left = weights_of(alpha), transmittances(alpha)[-1:]
    if stop is None:
        return weights, left
    light = transmittances(alpha.detach())
    last = (light[:-1] >= stop) & (light[1:] < stop)
    opaque = weights_of(torch.where(last, 1, alpha))
    weights = weights.detach() + opaque - opaque.detach()
    return weights, torch.where(last.any(dim=0), left.detach(), left)
