"""One (Gaussian, pixel) pair: how far, how opaque, drawn or not."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import torch
from torch import Tensor

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


def squared_distances(footprints: Footprints, pixels: Tensor) -> Tensor:
    """(K, P) squared Mahalanobis distance q of pixels (P, 2) from each mean."""
    dx, dy = (footprints.mean2d[:, None, :] - pixels).unbind(-1)
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


def cap(alpha: Tensor, alpha_max: float) -> Tensor:
    """Alpha, at most alpha_max; the gradient passes as if uncapped, as in the host's backward."""
    return alpha + (alpha.clamp(max=alpha_max) - alpha).detach()


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
    alpha = cap(footprints.opacity[:, None] * falloff, options.alpha_max)
    return Fragments(alpha=alpha * gate, gate=gate, drawn=gate.detach() > 0)
