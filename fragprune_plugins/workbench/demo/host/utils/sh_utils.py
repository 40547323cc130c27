"""Real spherical harmonics up to degree 3."""

import torch

C0 = 0.28209479177387814


def RGB2SH(rgb):  # noqa: N802 - the name other tools look for
    """The constant coefficient that gives a colour."""
    return (rgb - 0.5) / C0


def eval_sh(degree, coefficients, directions):
    """Sum (N, 3), before the offset of one half.

    Args:
        degree: 0 to 3.
        coefficients: (N, 3, K), K >= (degree + 1)^2.
        directions: (N, 3), unit vectors.
    """
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, C0)]
    if degree > 0:
        basis += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree > 1:
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (3 * z * z - 1),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if degree > 2:
        basis += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (5 * z * z - 1),
            0.3731763325901154 * z * (5 * z * z - 3),
            -0.4570457994644658 * x * (5 * z * z - 1),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return (coefficients[..., : len(basis)] * torch.stack(basis, dim=-1)[:, None]).sum(-1)
