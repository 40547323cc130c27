"""Cuts a Gaussian in space and time at one moment: a 3D Gaussian remains.

Space and time have one covariance. At a given moment the 3D Gaussian is the conditional one. Its
mean moves linearly, and its opacity is multiplied by the likelihood of the moment (the marginal).
Gradients are those of RT-4DGS's hand-written kernels. Docstrings say where these differ from the
derivative.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from reference_renderer.covariance import rotation_matrices

MARGINAL_MIN = 0.05
"""At or below it a Gaussian is not there."""


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
        means: (N, 3).
        opacities: (N,).
        times: (N,) means in time.
        scales: (N, 4): standard deviations x, y, z, and the variance in time.
        rotations: (N, 4) quaternions.
        timestamp: the moment.
        prefilter_var: when positive, added to the variance in time.
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
