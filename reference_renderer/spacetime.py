"""Gaussians in space and time, cut at a moment; the 3D Gaussians are drawn as usual."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from reference_renderer.color4d import Clock, colors
from reference_renderer.covariance import rotation_matrices
from reference_renderer.slice4d import Sliced, covariance, joint, separate, upper


@dataclass(frozen=True)
class SpacetimeGaussians:
    """N Gaussians in space and time, given in one of four ways.

    ``cov3d``: sliced already. ``scales`` and ``rotations``: in space alone. With ``times`` and
    ``scales_t``: in time, apart from space. With ``rotations_r`` too: anywhere in space and time.

    Attributes:
        means: (N, 3) world.
        opacities: (N,).
        times: (N,) means in time.
        scales: (N, 3) standard deviations.
        scales_t: (N,) in time: a standard deviation with ``rotations_r``, else a variance.
        rotations: (N, 4) quaternions w, x, y, z, used as given.
        rotations_r: (N, 4) the right ones; ``rotations`` are the left ones then.
        cov3d: (N, 6) upper triangle xx, xy, xz, yy, yz, zz.
        sh: (N, K, 3), 16 coefficients to each cosine in time; or None.
        sh_degree: 0 to 3.
    """

    means: Tensor
    opacities: Tensor
    times: Tensor | None = None
    scales: Tensor | None = None
    scales_t: Tensor | None = None
    rotations: Tensor | None = None
    rotations_r: Tensor | None = None
    cov3d: Tensor | None = None
    sh: Tensor | None = None
    sh_degree: int = 0


def slice_gaussians(
    given: SpacetimeGaussians,
    *,
    campos: Tensor,
    timestamp: float,
    duration: float = 1.0,
    sh_degree_t: int | None = None,
    prefilter_var: float = -1.0,
    scale_modifier: float = 1.0,
) -> Sliced:
    """Cut at a moment. Absent Gaussians have their mean at the camera, and zeros elsewhere.

    Args:
        given: the Gaussians.
        campos: (3,) the camera.
        timestamp: the moment.
        duration: the cosines' longest period.
        sh_degree_t: cosines in use, 0 to 2; None for colours without time.
        prefilter_var: if positive, added to the variance in time of the marginal.
        scale_modifier: factor on the scales.
    """
    cut = _cut(given, scale_modifier, timestamp=timestamp, prefilter_var=prefilter_var)
    there = cut.present & cut.cov3d.isfinite().all(dim=1)
    row, zero = there[:, None], given.opacities.new_zeros(1)
    painted = None
    if given.sh is not None:
        clock = None
        if sh_degree_t is not None:
            assert given.times is not None
            clock = Clock(given.times, timestamp, duration, sh_degree_t)
        painted = colors(given.sh, given.means, cut.means, campos, given.sh_degree, clock)
        painted = torch.where(row, painted, zero)
    return replace(
        cut,
        means=torch.where(row, cut.means, campos),
        cov3d=torch.where(row, cut.cov3d, zero),
        opacities=torch.where(there, cut.opacities, zero),
        present=there,
        colors=painted,
    )


def _cut(
    given: SpacetimeGaussians, scale_modifier: float, *, timestamp: float, prefilter_var: float
) -> Sliced:
    """The cut without colours, for present and absent Gaussians alike."""
    everyone = torch.ones_like(given.opacities, dtype=torch.bool)
    if given.cov3d is not None:
        return Sliced(given.means, given.cov3d, given.opacities, everyone)
    assert given.scales is not None
    assert given.rotations is not None
    scales, turns = scale_modifier * given.scales, given.rotations
    if given.scales_t is None:
        cov3d = upper(covariance(rotation_matrices(turns), scales))
        return Sliced(given.means, cov3d, given.opacities, everyone)
    assert given.times is not None
    scales = torch.cat([scales, scale_modifier * given.scales_t[:, None]], dim=1)
    means, opacities, times = given.means, given.opacities, given.times
    when = {"timestamp": timestamp, "prefilter_var": prefilter_var}
    if given.rotations_r is None:
        return separate(means, opacities, times, scales, turns, **when)
    return joint(means, opacities, times, scales, (turns, given.rotations_r), **when)
