"""Fragments, (Gaussian, pixel) pairs: their distance, their alpha, and whether they are drawn."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from reference_renderer.project import Footprints
from reference_renderer.scene import FALLOFF_MIN, RIM_REACH, RIM_WIDTH, Options
from reference_renderer.surfel import meet


@dataclass(frozen=True)
class Fragments:
    """The fragments of K Gaussians at P pixels.

    Attributes:
        alpha: (K, P) capped alpha times the gate, or the covered share; 0 where not drawn.
        gate: (K, P) 1 where drawn, else 0 (surrogate: between), with the thresholds' gradient.
        drawn: (K, P) bool, without regard to a pixel's stop.
        depth: (K, P) view depth of surfels' fragments, 1 where none is met; None of others.
    """

    alpha: Tensor
    gate: Tensor
    drawn: Tensor
    depth: Tensor | None = None


class Spread(torch.autograd.Function):
    """Expand means (K, 2) to P pixels, (K, P, 2); ``felt`` (K, 2) does not change the values.

    The means receive the sum over pixels of the gradient, and ``felt`` the sum of its absolute
    values.
    """

    @staticmethod
    def forward(ctx: Any, means: Tensor, felt: Tensor, pixels: int) -> Tensor:
        """Return the means as (K, P, 2)."""
        return means[:, None, :].repeat(1, pixels, 1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        """Return the gradients of the means and of ``felt``, (K, 2) each."""
        return grad.sum(dim=1), grad.abs().sum(dim=1), None


def offsets(footprints: Footprints, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """How far right of pixels (P, 2) and below them each mean lies, (K, P) both."""
    means = footprints.mean2d[:, None, :]
    if footprints.felt is not None:
        means = Spread.apply(  # type: ignore[no-untyped-call]
            footprints.mean2d, footprints.felt, len(pixels)
        )
    dx, dy = (means - pixels).unbind(-1)
    return dx, dy


def squared_distances(conic: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
    """(K, P) squared Mahalanobis distance q at ``offsets``, by conics (K, 3)."""
    xx, xy, yy = conic[:, :, None].unbind(1)
    return xx * dx * dx + yy * dy * dy + 2 * xy * dx * dy


def slopes(conic: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
    """(K, P) length of the gradient of q / 2 on the image, at least 1e-6; as above."""
    xx, xy, yy = conic[:, :, None].unbind(1)
    along, down = xx * dx + xy * dy, xy * dx + yy * dy
    return (along.square() + down.square()).clamp(min=1e-12).sqrt()


def visible_cutoffs(opacity: Tensor, alpha_min: float) -> Tensor:
    """(K,) largest q at which alpha reaches alpha_min; negative if it never does."""
    if alpha_min == 0:
        return torch.full_like(opacity, inf)
    return 2 * (opacity.detach() * (1 / alpha_min)).log()


def cutoffs(visible: Tensor, thresholds: Tensor | None) -> Tensor:
    """(K,) the cutoff: the largest q that is drawn.

    Args:
        visible: (K,) from ``visible_cutoffs``.
        thresholds: (K,) falloff, or None.
    """
    if thresholds is None:
        return visible
    return torch.minimum(-2 * thresholds.detach().log(), visible)


def rim_cutoffs(visible: Tensor, thresholds: Tensor) -> Tensor:
    """(K,) largest q at which a fragment still contributes to a threshold's gradient."""
    reach = (thresholds.detach() - RIM_REACH * RIM_WIDTH).clamp(min=FALLOFF_MIN)
    return torch.minimum(-2 * reach.log(), visible)


def cap(alpha: Tensor, alpha_max: float, with_gradient: bool) -> Tensor:
    """Cap alpha at alpha_max. Without ``with_gradient`` a capped alpha has no gradient."""
    capped = alpha.clamp(max=alpha_max)
    return alpha + (capped - alpha).detach() if with_gradient else capped


def covered(q: Tensor, slope: Tensor, thresholds: Tensor) -> Tensor:
    """(K, P) share of each pixel within the rim, which is one pixel wide.

    Args:
        q: (K, P) squared distances.
        slope: (K, P) length of the gradient of q / 2 on the image.
        thresholds: (K,) falloff.
    """
    inwards = -q / 2 - thresholds.log()[:, None]
    return (0.5 + inwards / slope).clamp(0, 1)


def surrogate(falloff: Tensor, thresholds: Tensor) -> Tensor:
    """(K, P) soft gate s((g - tau) / w) of falloffs (K, P) and thresholds (K,)."""
    return torch.sigmoid((falloff - thresholds[:, None]) / RIM_WIDTH)


def gates(
    q: Tensor, falloff: Tensor, visible: Tensor, thresholds: Tensor | None, options: Options
) -> Tensor:
    """(K, P) factor on alpha: hard with a straight-through gradient, or the surrogate.

    Args:
        q: (K, P) squared distances.
        falloff: (K, P) exp(-q / 2).
        visible: (K,) the cutoffs by alpha_min alone.
        thresholds: (K,) or None.
    """
    seen = (q >= 0) & (q <= visible[:, None])
    if thresholds is None:
        return seen.to(q.dtype)
    if options.rim == "surrogate":
        return seen * surrogate(falloff, thresholds)
    drawn = (q >= 0) & (q <= cutoffs(visible, thresholds)[:, None])
    rim = (q >= 0) & (q <= rim_cutoffs(visible, thresholds)[:, None])
    soft = surrogate(falloff.detach(), thresholds)
    return drawn + torch.where(rim, soft - soft.detach(), torch.zeros_like(soft))


def fragments(
    footprints: Footprints, pixels: Tensor, thresholds: Tensor | None, options: Options
) -> Fragments:
    """The fragments of K footprints at P pixels, x and y (P, 2), by thresholds (K,) or None."""
    dx, dy = offsets(footprints, pixels)
    q, depth = squared_distances(footprints.conic, dx, dy), None
    if footprints.plane is not None:
        q, depth = meet(footprints.plane, pixels, q, options.near)
    # Rounding can make q negative; such a fragment is skipped, and must not overflow here first.
    falloff = (-0.5 * q.clamp(min=0)).exp()
    visible = visible_cutoffs(footprints.opacity, options.alpha_min)
    alpha = cap(footprints.opacity[:, None] * falloff, options.alpha_max, options.cap_gradient)
    if options.rim == "soft" and thresholds is not None:
        seen = (q >= 0) & (q <= visible[:, None])
        slope = slopes(footprints.conic, dx, dy)
        share = seen * covered(q, slope, thresholds)
        drawn = share.detach() > 0
        felt = seen * covered(q.detach(), slope.detach(), thresholds)
        return Fragments(alpha * share, drawn + (felt - felt.detach()), drawn)
    gate = gates(q.detach(), falloff, visible, thresholds, options)
    return Fragments(alpha=alpha * gate, gate=gate, drawn=gate.detach() > 0, depth=depth)
