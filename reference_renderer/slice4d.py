"""Cuts Gaussians in space and time at one moment: 3D Gaussians remain, drawn as usual.

Space and time have one covariance. At a given moment the 3D Gaussian is the conditional one. Its
mean moves linearly, and its opacity is multiplied by the likelihood of the moment (the marginal).
Gradients are those of RT-4DGS's hand-written kernels. Docstrings say where these differ from the
derivative.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from reference_renderer.color4d import Clock, colors
from reference_renderer.covariance import rotation_matrices

MARGINAL_MIN = 0.05
"""At or below it a Gaussian is not there."""


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


@dataclass(frozen=True)
class Sliced:
    """N Gaussians at one moment.

    Attributes:
        means: (N, 3) world.
        cov3d: (N, 6) upper triangle xx, xy, xz, yy, yz, zz.
        opacities: (N,) multiplied by the marginal.
        present: (N,) bool, the Gaussians that are not culled by time.
        colors: (N, 3) RGB, or None.
    """

    means: Tensor
    cov3d: Tensor
    opacities: Tensor
    present: Tensor
    colors: Tensor | None = None


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


def _rows(*entries: Tensor) -> Tensor:
    """(N, n, n) of n * n columns (N,), row by row."""
    size = round(len(entries) ** 0.5)
    return torch.stack(entries, dim=-1).reshape(-1, size, size)


def rotation_4d(left: Tensor, right: Tensor) -> Tensor:
    """(N, 4, 4) rotation of x, y, z, t by two quaternions (N, 4) each, used as given.

    With (t, z, y, x) as a quaternion v, the rotation is v -> left v right*.
    """
    a, b, c, d = left.unbind(-1)
    p, q, r, s = right.unbind(-1)
    by_left = _rows(*(a, b, -c, d), *(-b, a, d, c), *(c, -d, a, b), *(-d, -c, -b, a))
    by_right = _rows(*(p, q, -r, -s), *(-q, p, s, -r), *(r, -s, p, -q), *(s, r, q, p))
    return by_left @ by_right


def covariance(rotations: Tensor, scales: Tensor) -> Tensor:
    """(N, n, n) of rotation matrices (N, n, n) and standard deviations (N, n) along their axes."""
    axes = rotations * scales[:, None, :]
    return axes @ axes.transpose(1, 2)


def upper(matrices: Tensor) -> Tensor:
    """(N, 6) upper triangle of symmetric matrices, the first three of their rows and columns."""
    rows, columns = torch.triu_indices(3, 3, device=matrices.device)
    return matrices[:, rows, columns]


def joint(
    means: Tensor,
    opacities: Tensor,
    times: Tensor,
    scales: Tensor,
    rotations: tuple[Tensor, Tensor],
    *,
    timestamp: float,
    prefilter_var: float = -1.0,
) -> Sliced:
    """Cut Gaussians with any axes in space and time (``rot_4d``).

    Args:
        means: (N, 3).
        opacities: (N,).
        times: (N,) means in time.
        scales: (N, 4) standard deviations, x, y, z, t.
        rotations: left and right quaternions (N, 4).
        timestamp: the moment.
        prefilter_var: if positive, added to the variance in time of the marginal.
    """
    cov4d = covariance(rotation_4d(*rotations), scales)
    in_time, across = cov4d[:, 3, 3], cov4d[:, :3, 3]
    since = timestamp - times
    marginal = _marginal(since, in_time, prefilter_var)
    velocity = across / in_time[:, None]
    cov3d = upper(cov4d) - upper(across[:, :, None] * velocity[:, None, :])
    return Sliced(
        means=means + velocity * since[:, None],
        cov3d=cov3d,
        opacities=opacities * marginal,
        present=marginal > MARGINAL_MIN,
    )


def separate(
    means: Tensor,
    opacities: Tensor,
    times: Tensor,
    scales: Tensor,
    rotations: Tensor,
    *,
    timestamp: float,
    prefilter_var: float = -1.0,
) -> Sliced:
    """Cut Gaussians without motion, with a separate extent in time (4D without ``rot_4d``).

    The host uses the scale in time as a variance, without squaring it. Its backward pass ignores
    the marginal: opacity receives the gradient by the drawn opacity, and time and its scale receive
    zeros.

    Args:
        scales: (N, 4): standard deviations x, y, z, and the variance in time.
        rotations: (N, 4) quaternions. The rest is as in ``joint``.
    """
    since = (timestamp - times).detach()
    marginal = _marginal(since, scales[:, 3].detach(), prefilter_var)
    strength = (opacities * marginal).detach() + (opacities - opacities.detach())
    return Sliced(
        means=means,
        cov3d=upper(covariance(rotation_matrices(rotations), scales[:, :3])),
        opacities=strength + 0.0 * (times + scales[:, 3]),
        present=marginal > MARGINAL_MIN,
    )


def _marginal(since: Tensor, variance: Tensor, prefilter_var: float) -> Tensor:
    """(N,) the likelihood of the moment, 1 at the mean in time."""
    return torch.exp(-0.5 * since * since / (variance + max(prefilter_var, 0.0)))
