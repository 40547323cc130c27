"""Real spherical harmonics with the signs of 3DGS, for dialects that colour in torch."""

from __future__ import annotations

import torch
from torch import Tensor

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (-0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154)
C3_2 = 1.445305721320277


def basis(directions: Tensor, degree: int) -> Tensor:
    """(N, (degree + 1)^2) real spherical harmonics of unit directions (N, 3), signs as in 3DGS."""
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, C0)]
    if degree > 0:
        values += [-C1 * y, C1 * z, -C1 * x]
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        values += [C2[0] * x * y, C2[1] * y * z, C2[2] * (2 * zz - xx - yy)]
        values += [C2[1] * x * z, C2[3] * (xx - yy)]
    if degree > 2:
        values += [C3[0] * y * (3 * xx - yy), C3[1] * x * y * z, C3[2] * y * (4 * zz - xx - yy)]
        values += [C3[3] * z * (2 * zz - 3 * xx - 3 * yy), C3[2] * x * (4 * zz - xx - yy)]
        values += [C3_2 * z * (xx - yy), C3[0] * x * (xx - 3 * yy)]
    return torch.stack(values, dim=-1)
