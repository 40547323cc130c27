"""gsplat's projection of Gaussians in torch, for one camera, and their harmonics.

It differs from vanilla's: the Jacobian is clamped to the image's real bounds with the principal
point. Since 1.5 extents are per axis and end where alpha falls below 1/255 or at 3.33 sigma;
before, they were squares as vanilla's.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from fragprune_plugins.adapting import ALPHA_MIN, rotations

TILE = 16
EXTENT, SQUARE = 3.33, 3.0  # in sigma: since 1.5 per axis, until 1.4 along the longer one
MARGIN = 0.3  # of the tangent of the half field of view, beyond the image, for the Jacobian
C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (-0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154)
C3_2 = 1.445305721320277  # of real spherical harmonics with the signs of 3DGS


@dataclass(frozen=True)
class Rules:
    """Settings of the projection, from the call and the installed version."""

    eps2d: float  # pixels^2 added to the 2D covariance's diagonal
    near: float  # view depth below which a Gaussian is culled
    far: float  # likewise above
    radius_clip: float  # pixels; radii up to it are culled
    antialiased: bool  # opacity is multiplied by sqrt(det before / det after eps2d)
    floor: float  # least value of that factor
    tight: bool
    """Extents are per axis and follow opacity; otherwise they are squares, and Gaussians of any
    opacity count as visible."""


@dataclass(frozen=True)
class Projection:
    """N Gaussians as one camera sees them; rows that are culled have radii 0."""

    radii: Tensor  # (N, 2) int32 pixels, per axis
    means2d: Tensor  # (N, 2) pixels; the first pixel's centre is (0.5, 0.5)
    depths: Tensor  # (N,) view depth
    conics: Tensor  # (N, 3) inverse covariances xx, xy, yy
    opacities: Tensor  # (N,) compensated where the call asks for it
    tiles: Tensor  # (N, 4) int32 half-open rectangle of tiles

    @property
    def visible(self) -> Tensor:
        """(N,) bool."""
        return (self.radii > 0).all(dim=-1)


def product(a: Tensor, b: Tensor) -> Tensor:
    """a @ b to the last bits of float32.

    On a GPU, a host may let torch multiply matrices with 10 of the 23 (TF32). gsplat's kernels do
    not, and it would put Gaussians beside their pixels.
    """
    return (a[..., :, :, None] * b[..., None, :, :]).sum(-2) if a.is_cuda else a @ b


def covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """(N, 3, 3) from quaternions (N, 4) w, x, y, z of any length and activated scales (N, 3)."""
    root = rotations(torch.nn.functional.normalize(quats, dim=-1)) * scales[:, None]
    return product(root, root.transpose(-1, -2))


def project(
    means: Tensor,
    covars: Tensor,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    rules: Rules,
) -> Projection:
    """Project N Gaussians; differentiable in means, covars, opacities and viewmat.

    Means (N, 3) and covars (N, 3, 3) are in the world, opacities (N,) activated; viewmat (4, 4)
    acts on column vectors, K (3, 3) has the intrinsics.
    """
    rotation = viewmat[:3, :3]
    seen = product(means[:, None], rotation.T)[:, 0] + viewmat[:3, 3]
    depths = seen[:, 2]
    inside = (depths >= rules.near) & (depths <= rules.far)
    seen = torch.where(inside[:, None], seen, seen.new_tensor([0.0, 0.0, 1.0]))
    size, focal, centre = K.new_tensor([width, height]), K[[0, 1], [0, 1]], K[:2, 2]
    z, slope = seen[:, 2:], seen[:, :2] / seen[:, 2:]
    means2d = focal * slope + centre
    margin = MARGIN * 0.5 * size / focal
    bounded = torch.clamp(slope, -centre / focal - margin, (size - centre) / focal + margin)
    zero = torch.zeros_like(z[:, 0])
    jacobian = torch.stack(
        [
            torch.stack([focal[0] / z[:, 0], zero, -focal[0] * bounded[:, 0] / z[:, 0]], dim=-1),
            torch.stack([zero, focal[1] / z[:, 0], -focal[1] * bounded[:, 1] / z[:, 0]], dim=-1),
        ],
        dim=-2,
    )
    flat = product(jacobian, rotation)
    cov = product(product(flat, covars), flat.transpose(-1, -2))
    a, b, c = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    before = a * c - b * b
    a, c = a + rules.eps2d, c + rules.eps2d
    det = a * c - b * b
    inside = inside & (det > 0)
    det = torch.where(inside, det, 1.0)
    if rules.antialiased:
        least = max(rules.floor**2, 1e-12)  # a root's slope at 0 is not to be had
        opacities = opacities * (before / det).clamp_min(least).sqrt()
    with torch.no_grad():
        if rules.tight:
            inside = inside & (opacities >= ALPHA_MIN)
            reach = (2 * torch.log(opacities.clamp_min(ALPHA_MIN) / ALPHA_MIN)).sqrt()
            sigma = torch.stack([a, c], dim=-1).clamp_min(0).sqrt()
            radii = torch.ceil(reach.clamp_max(EXTENT)[:, None] * sigma)
        else:
            middle = (a + c) / 2
            longest = middle + (middle**2 - det).clamp_min(0.01).sqrt()  # eigenvalue
            radii = torch.ceil(SQUARE * longest.sqrt())[:, None].expand(-1, 2)
        drawn = inside & (radii > rules.radius_clip).any(dim=-1)
        drawn &= ((means2d + radii > 0) & (means2d - radii < size)).all(dim=-1)
        radii = torch.where(drawn[:, None], radii, 0.0)
        grid = torch.ceil(size / TILE)
        first = torch.floor((means2d - radii) / TILE).clamp_min(0).minimum(grid)
        last = torch.ceil((means2d + radii) / TILE).clamp_min(0).minimum(grid)
        tiles = torch.where(drawn[:, None], torch.cat([first, last], dim=-1), 0.0).int()
    conics = torch.stack([c / det, -b / det, a / det], dim=-1)
    return Projection(radii.int(), means2d, depths, conics, opacities, tiles)


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
