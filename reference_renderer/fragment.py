"""One (Gaussian, pixel) pair: how far, how opaque, drawn or not."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from reference_renderer.project import Footprints
from reference_renderer.scene import FALLOFF_MIN, RIM_REACH, RIM_WIDTH, Options


@dataclass(frozen=True)
class Fragments:
    """K Gaussians at P pixels.

    Attributes:
        alpha: (K, P) capped, and times the gate: 0 where not drawn.
        gate: (K, P) 1 where drawn, else 0 (soft: between), with the thresholds' gradient.
        drawn: (K, P) bool, before any pixel's stop.
    """

    alpha: Tensor
    gate: Tensor
    drawn: Tensor


class Spread(torch.autograd.Function):
    """Means (K, 2) at each of P pixels, (K, P, 2); ``felt`` (K, 2) changes nothing.

    The means receive the sum over pixels of the gradient, ``felt`` that of its absolute values.
    """

    @staticmethod
    def forward(ctx: Any, means: Tensor, felt: Tensor, pixels: int) -> Tensor:
        """(K, P, 2)."""
        return means[:, None, :].repeat(1, pixels, 1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        """(K, 2) twice."""
        return grad.sum(dim=1), grad.abs().sum(dim=1), None


def squared_distances(footprints: Footprints, pixels: Tensor) -> Tensor:
    """(K, P) squared Mahalanobis distance q of pixels (P, 2) from each mean."""
    means = footprints.mean2d[:, None, :]
    if footprints.felt is not None:
        means = Spread.apply(  # type: ignore[no-untyped-call]
            footprints.mean2d, footprints.felt, len(pixels)
        )
    dx, dy = (means - pixels).unbind(-1)
    xx, xy, yy = footprints.conic[:, :, None].unbind(1)
    return xx * dx * dx + yy * dy * dy + 2 * xy * dx * dy


def visible_cutoffs(opacity: Tensor, alpha_min: float) -> Tensor:
    """(K,) largest q at which alpha still reaches alpha_min; negative when it never does."""
    if alpha_min == 0:
        return torch.full_like(opacity, inf)
    return 2 * (opacity.detach() * (1 / alpha_min)).log()


def cutoffs(visible: Tensor, thresholds: Tensor | None) -> Tensor:
    """(K,) largest q that is drawn: the one number that decides, everywhere.

    Args:
        visible: (K,) from ``visible_cutoffs``.
        thresholds: (K,) falloff, or None.
    """
    if thresholds is None:
        return visible
    return torch.minimum(-2 * thresholds.detach().log(), visible)


def rim_cutoffs(visible: Tensor, thresholds: Tensor) -> Tensor:
    """(K,) largest q at which a threshold still feels a fragment; at least the drawn ones."""
    reach = (thresholds.detach() - RIM_REACH * RIM_WIDTH).clamp(min=FALLOFF_MIN)
    return torch.minimum(-2 * reach.log(), visible)


def cap(alpha: Tensor, alpha_max: float, with_gradient: bool) -> Tensor:
    """Alpha, at most alpha_max; the gradient passes as if uncapped, or stops where capped."""
    capped = alpha.clamp(max=alpha_max)
    return alpha + (capped - alpha).detach() if with_gradient else capped


def surrogate(falloff: Tensor, thresholds: Tensor) -> Tensor:
    """(K, P) soft gate s((g - tau) / w) of falloffs (K, P) and thresholds (K,)."""
    return torch.sigmoid((falloff - thresholds[:, None]) / RIM_WIDTH)


def gates(
    q: Tensor, falloff: Tensor, visible: Tensor, thresholds: Tensor | None, options: Options
) -> Tensor:
    """(K, P) factor on alpha: hard with a straight-through gradient, or soft.

    Args:
        q: (K, P) squared distances.
        falloff: (K, P) exp(-q / 2).
        visible: (K,) cutoffs of alpha_min alone.
        thresholds: (K,) or None.
        options: ``truncation`` chooses.
    """
    seen = (q >= 0) & (q <= visible[:, None])
    if thresholds is None:
        return seen.to(q.dtype)
    if options.truncation == "soft":
        return seen * surrogate(falloff, thresholds)
    drawn = (q >= 0) & (q <= cutoffs(visible, thresholds)[:, None])
    rim = (q >= 0) & (q <= rim_cutoffs(visible, thresholds)[:, None])
    soft = surrogate(falloff.detach(), thresholds)
    return drawn + torch.where(rim, soft - soft.detach(), torch.zeros_like(soft))


def fragments(
    footprints: Footprints, pixels: Tensor, thresholds: Tensor | None, options: Options
) -> Fragments:
    """Every footprint at every pixel.

    Args:
        footprints: K of them.
        pixels: (P, 2) x, y.
        thresholds: (K,) or None.
        options: the cuts.
    """
    q = squared_distances(footprints, pixels)
    # Rounding can make q negative; such a fragment is skipped, and must not overflow here first.
    falloff = (-0.5 * q.clamp(min=0)).exp()
    visible = visible_cutoffs(footprints.opacity, options.alpha_min)
    gate = gates(q.detach(), falloff, visible, thresholds, options)
    alpha = cap(footprints.opacity[:, None] * falloff, options.alpha_max, options.cap_gradient)
    return Fragments(alpha=alpha * gate, gate=gate, drawn=gate.detach() > 0)
