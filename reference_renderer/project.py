"""Projects Gaussians in the world to footprints on the image, and finds their tiles."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from reference_renderer.covariance import covariances, project_covariances
from reference_renderer.scene import Camera, Gaussians, Options, Table
from reference_renderer.sh import sh_colors

TILE = 16
"""Side of a tile, pixels."""

ANTIALIASING_FLOOR = 2.5e-5
"""Least ratio of determinants that the antialiasing compensation takes the root of."""

MIP_FLOOR = 1e-6
"""Least determinant that Mip-Splatting draws at all; also what it adds against division by 0."""


@dataclass(frozen=True)
class Footprints(Table):
    """K Gaussians on the image.

    Attributes:
        mean2d: (K, 2) pixels; (0, 0) is the centre of the first pixel.
        conic: (K, 3) inverse covariance xx, xy, yy, pixels^-2.
        depth: (K,) view space.
        opacity: (K,) after compensation.
        color: (K, 3) RGB.
        radius: (K,) pixels, ceil(3 sigma) of the longer axis; 0 when degenerate.
        features: (K, F) more channels, or None.
        felt: (K, 2) zeros that receive the sum of absolute values of the means' gradient; or None.
        plane: (K, 3, 3) of surfels, from ``surfel.planes``; None of others.
        normal: (K, 3) of surfels, view space, toward the camera; None of others.
    """

    mean2d: Tensor
    conic: Tensor
    depth: Tensor
    opacity: Tensor
    color: Tensor
    radius: Tensor
    features: Tensor | None = None
    felt: Tensor | None = None
    plane: Tensor | None = None
    normal: Tensor | None = None


def transform(points: Tensor, matrix: Tensor) -> Tensor:
    """(N, 4) homogeneous row vectors [p, 1] @ matrix, of points (N, 3)."""
    return points @ matrix[:3] + matrix[3]


def rows_in_front(camera: Camera, means: Tensor, near: float) -> Tensor:
    """(K,) rows of the means (N, 3) beyond the near plane, the host's only frustum test."""
    return (transform(means.detach(), camera.viewmatrix)[:, 2] > near).nonzero()[:, 0]


def project_means(camera: Camera, means: Tensor) -> Tensor:
    """(N, 2) pixels of means (N, 3)."""
    clip = transform(means, camera.projmatrix)
    ndc = clip[:, :2] * (1 / (clip[:, 3:] + 1e-7))
    size = means.new_tensor([camera.width, camera.height])
    return ((ndc + 1) * size - 1) / 2


def hooked(camera: Camera, footprints: Footprints, hook: Tensor, options: Options) -> Footprints:
    """The same footprints, with a hook (K, >= 2) that receives their means' gradient in NDC.

    Of surfels it receives what moves the plane alone, times the centre's depth, as in the host.
    """
    half = 0.5 * hook.new_tensor([camera.width, camera.height])
    zero = hook - hook.detach()
    if footprints.plane is not None:
        moved = footprints.depth.detach()[:, None] * half * zero[:, :2]
        moved = torch.nn.functional.pad(moved[:, :, None], (2, 0, 0, 1))
        return replace(footprints, plane=footprints.plane + moved)
    return replace(
        footprints,
        mean2d=footprints.mean2d + half * zero[:, :2],
        felt=half * zero[:, 2:3] if options.absolute_gradient else None,
    )


def determinant(cov2d: Tensor) -> Tensor:
    """(N,) of symmetric matrices given as (N, 3) xx, xy, yy."""
    return cov2d[:, 0] * cov2d[:, 2] - cov2d[:, 1] * cov2d[:, 1]


def radii_of(cov2d: Tensor) -> Tensor:
    """(N,) pixels, ceil(3 sigma) of covariances (N, 3); 0 where the determinant is 0."""
    det = determinant(cov2d)
    mid = 0.5 * (cov2d[:, 0] + cov2d[:, 2])
    largest = mid + (mid * mid - det).clamp(min=0.1).sqrt()
    return torch.where(det == 0, torch.zeros_like(det), (3 * largest.sqrt()).ceil())


def invert(cov2d: Tensor) -> Tensor:
    """(N, 3) inverses of covariances (N, 3); where singular, finite and meaningless."""
    det = determinant(cov2d)
    det = torch.where(det == 0, torch.ones_like(det), det)
    return torch.stack([cov2d[:, 2] / det, -cov2d[:, 1] / det, cov2d[:, 0] / det], dim=-1)


def compensate_antialiasing(before: Tensor, after: Tensor) -> Tensor:
    """(N,) root of the ratio of determinants of covariances (N, 3), not below a floor."""
    det = determinant(after)
    ratio = determinant(before) / torch.where(det == 0, torch.ones_like(det), det)
    return ratio.clamp(min=ANTIALIASING_FLOOR).sqrt()


def compensate_mip(before: Tensor, after: Tensor) -> Tensor:
    """(N,) Mip-Splatting's factor from covariances (N, 3): 0 where a determinant is too small.

    The derivatives are those of the formula. The host's backward pass adds small numbers to other
    denominators. With a factor c and a determinant d after dilation, its gradient through the
    factor has a relative error of 2e-6 / c, and the part through d one of 1e-6 / d^2. That is at
    most 1% for the host's kernel size of 0.1 (d >= 0.01), and negligible for larger Gaussians.
    """
    sharp, wide = determinant(before), determinant(after)
    draws = (sharp > MIP_FLOOR) & (wide > MIP_FLOOR)
    sharp, wide = sharp.clamp(min=MIP_FLOOR), wide.clamp(min=MIP_FLOOR)
    factor = (sharp / (wide + MIP_FLOOR) + MIP_FLOOR).sqrt()
    return torch.where(draws, factor, torch.zeros_like(factor))


def project(camera: Camera, gaussians: Gaussians, options: Options) -> Footprints:
    """Footprints of Gaussians that are all in front of the camera.

    Args:
        options: scale_modifier, dilation and compensation are used.
    """
    points = transform(gaussians.means, camera.viewmatrix)[:, :3]
    cov3d = covariances(gaussians, options.scale_modifier)
    sharp = project_covariances(camera, points, cov3d)
    cov2d = sharp + options.dilation * sharp.new_tensor([1, 0, 1])
    opacity = gaussians.opacities
    if options.compensation == "antialiasing":
        opacity = opacity * compensate_antialiasing(sharp, cov2d)
    if options.compensation == "mip":
        opacity = opacity * compensate_mip(sharp, cov2d)
    return Footprints(
        mean2d=project_means(camera, gaussians.means),
        conic=invert(cov2d),
        depth=points[:, 2],
        opacity=opacity,
        color=colors_of(camera, gaussians),
        radius=radii_of(cov2d.detach()),
        features=gaussians.features,
    )


def colors_of(camera: Camera, gaussians: Gaussians) -> Tensor:
    """(N, 3) RGB, given or from spherical harmonics."""
    if gaussians.colors is not None:
        return gaussians.colors
    if gaussians.sh is None:
        raise ValueError("Gaussians: neither sh nor colors are given")
    return sh_colors(gaussians.means, camera.campos, gaussians.sh, gaussians.sh_degree)


def tile_grid(camera: Camera) -> tuple[int, int]:
    """Tiles across and down; the last ones may reach over the image's edge."""
    return -(-camera.width // TILE), -(-camera.height // TILE)


def tile_rects(camera: Camera, footprints: Footprints) -> Tensor:
    """(K, 4) first and past-the-last tile x0, y0, x1, y1 of the 3-sigma square, in the grid.

    Rounding is toward zero before clamping, as a C cast does (auxiliary.h, getRect).
    """
    mean2d, radius = footprints.mean2d.detach(), footprints.radius[:, None]
    first = ((mean2d - radius) / TILE).trunc()
    last = ((mean2d + radius + TILE - 1) / TILE).trunc()
    grid = mean2d.new_tensor(tile_grid(camera))
    return torch.cat([first.clamp(min=0).minimum(grid), last.clamp(min=0).minimum(grid)], dim=1)
