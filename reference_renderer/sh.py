"""View-dependent colour: real spherical harmonics up to degree 3."""

from __future__ import annotations

from math import pi, sqrt

import torch
from torch import Tensor


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """(N, (degree + 1)^2) real spherical harmonics of unit directions (N, 3), in 3DGS's order.

    Bands in turn, m from -l to l within each, with the Condon-Shortley phase.
    """
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    bands = [
        [torch.full_like(x, sqrt(1 / (4 * pi)))],
        [-sqrt(3 / (4 * pi)) * y, sqrt(3 / (4 * pi)) * z, -sqrt(3 / (4 * pi)) * x],
        [
            sqrt(15 / (4 * pi)) * x * y,
            -sqrt(15 / (4 * pi)) * y * z,
            sqrt(5 / (16 * pi)) * (2 * zz - xx - yy),
            -sqrt(15 / (4 * pi)) * x * z,
            sqrt(15 / (16 * pi)) * (xx - yy),
        ],
        [
            -sqrt(35 / (32 * pi)) * y * (3 * xx - yy),
            sqrt(105 / (4 * pi)) * x * y * z,
            -sqrt(21 / (32 * pi)) * y * (4 * zz - xx - yy),
            sqrt(7 / (16 * pi)) * z * (2 * zz - 3 * xx - 3 * yy),
            -sqrt(21 / (32 * pi)) * x * (4 * zz - xx - yy),
            sqrt(105 / (16 * pi)) * z * (xx - yy),
            -sqrt(35 / (32 * pi)) * x * (xx - 3 * yy),
        ],
    ]
    return torch.stack([term for band in bands[: degree + 1] for term in band], dim=-1)


def sh_colors(means: Tensor, campos: Tensor, sh: Tensor, degree: int) -> Tensor:
    """(N, 3) RGB seen from campos (3,): SH + 0.5, clamped at 0, no gradient where clamped.

    Args:
        means: (N, 3) world.
        campos: (3,) world.
        sh: (N, K, 3), the first (degree + 1)^2 coefficients are used.
        degree: 0 to 3.
    """
    offsets = means - campos
    directions = offsets / offsets.norm(dim=-1, keepdim=True)
    basis = sh_basis(directions, degree)
    rgb = (basis[:, :, None] * sh[:, : basis.shape[1]]).sum(dim=1)
    return (rgb + 0.5).clamp(min=0)
