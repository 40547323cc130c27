"""Surfels: flat Gaussians, which a pixel's ray meets in their own plane (2D Gaussian Splatting).

Huang et al., "2D Gaussian Splatting for Geometrically Accurate Radiance Fields", SIGGRAPH 2024. The
rules and the quirks are those of its CUDA rasterizer (hbb1/diff-surfel-rasterization).

A surfel's squared distance from a pixel is u^2 + v^2 where the ray meets the plane, u and v in
standard deviations. Seen from the side or from afar a surfel is less than a pixel wide; so the
distance is at most that of a round Gaussian of 1/2 pixel^2 at its centre on the image.
"""

from __future__ import annotations

import torch
from torch import Tensor

from reference_renderer.covariance import rotation_matrices
from reference_renderer.project import Footprints, colors_of, transform
from reference_renderer.scene import Camera, Gaussians, Options

FILTER = 2.0
"""Inverse variance, pixels^-2, of the round Gaussian at a surfel's centre."""

REACH = 3.0
"""Standard deviations whose bounding box gives a surfel's centre, radius and tiles."""

FAR = 100.0
"""View depth that the distortion maps to 1; the near plane is mapped to 0."""


def project_surfels(camera: Camera, gaussians: Gaussians, options: Options) -> Footprints:
    """Footprints of K surfels, with scales (K, 2), whose means are all in front of the camera."""
    assert gaussians.scales is not None
    assert gaussians.rotations is not None
    axes = rotation_matrices(gaussians.rotations)
    sides = axes[:, :, :2] * (options.scale_modifier * gaussians.scales)[:, None, :]
    plane = planes(camera, gaussians.means, sides)
    points = transform(gaussians.means, camera.viewmatrix)[:, :3]
    normal = axes[:, :, 2] @ camera.viewmatrix[:3, :3]
    facing = -(points * normal).sum(dim=1).detach()
    mean2d, half, bounded = bounds(plane)
    radius = half.max(dim=1).values.clamp(min=REACH / FILTER**0.5).ceil()
    return Footprints(
        mean2d=mean2d,
        conic=mean2d.new_tensor([FILTER, 0, FILTER]).expand(len(mean2d), 3),
        depth=points[:, 2],
        opacity=gaussians.opacities,
        color=colors_of(camera, gaussians),
        radius=torch.where(bounded & (facing != 0), radius, 0),
        plane=plane,
        normal=normal * facing.sign()[:, None],
    )


def planes(camera: Camera, means: Tensor, sides: Tensor) -> Tensor:
    """(K, 3, 3) maps of a plane's (u, v, 1) to (x w, y w, w), pixels and view depth.

    Args:
        means: (K, 3) world, where u = v = 0.
        sides: (K, 3, 2) world, the steps of u and of v.
    """
    width, height = camera.width, camera.height
    to_pixels = means.new_zeros(4, 3)
    to_pixels[0, 0], to_pixels[1, 1] = width / 2, height / 2
    to_pixels[3] = means.new_tensor([(width - 1) / 2, (height - 1) / 2, 1])
    to_image = camera.projmatrix @ to_pixels
    rows = torch.cat([sides.mT @ to_image[:3], (means @ to_image[:3] + to_image[3])[:, None]], 1)
    return rows.mT


def bounds(plane: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The bounding box on the image of each surfel out to ``REACH``.

    Where that part of the plane reaches behind the camera, the numbers mean nothing; the host uses
    them all the same.

    Returns:
        (K, 2) centre; (K, 2) half of the sides, without gradient, at least 0.01; (K,) bool,
        False where there is no box. Pixels.
    """
    weights = plane.new_tensor([REACH**2, REACH**2, -1])
    w = plane[:, 2]
    scale = (weights * w * w).sum(dim=1)
    bounded = scale.detach() != 0
    weights = weights / torch.where(bounded, scale, 1)[:, None]
    xy = plane[:, :2]
    centre = (weights[:, None] * xy * w[:, None]).sum(dim=2)
    square = centre * centre - (weights[:, None] * xy * xy).sum(dim=2)
    return centre, square.detach().clamp(min=1e-4).sqrt(), bounded


def meet(plane: Tensor, pixels: Tensor, filtered: Tensor, near: float) -> tuple[Tensor, Tensor]:
    """Where the rays of pixels (P, 2) meet planes (K, 3, 3).

    As in the host, where the round Gaussian is nearer than the plane's, the point on the plane is a
    constant for the depth.

    Args:
        plane: from ``planes``.
        pixels: x, y.
        filtered: (K, P) squared distances of the round Gaussians.
        near: view depth below which nothing is met.

    Returns:
        (K, P) squared distances, -1 where nothing is met; (K, P) view depths, 1 there.
    """
    x, y = pixels[None, :, 0:1], pixels[None, :, 1:2]
    across, down, w = plane[:, None].unbind(2)
    line = torch.linalg.cross(x * w - across, y * w - down)  # of all points on the pixel's ray
    met = line[..., 2].detach() != 0
    point = line[..., :2] / torch.where(met, line[..., 2], 1)[..., None]
    on_plane = point.square().sum(dim=-1)
    nearer = on_plane.detach() <= filtered.detach()
    point = torch.where(nearer[..., None], point, point.detach())
    depth = (point * w[..., :2]).sum(dim=-1) + w[..., 2]
    met = met & (depth.detach() >= near)
    q = torch.where(nearer, on_plane, filtered)
    return torch.where(met, q, -1), torch.where(met, depth, 1)


def surface_of(
    weights: Tensor, light: Tensor, drawn: Tensor, depth: Tensor, normal: Tensor, near: float
) -> Tensor:
    """(6, P): sum of w depth, of w normal (3), the median depth, the distortion.

    The median depth is that of the last drawn fragment before which more than half of the light is
    left, 0 where there is none. The distortion is the sum over pairs of fragments of
    w_i w_j (m_i - m_j)^2, where m maps depths near to 0 and ``FAR`` to 1, evenly in 1 / depth.

    Args:
        weights: (K, P) front to back, 0 where not drawn or stopped; w.
        light: (K, P) before each fragment.
        drawn: (K, P) bool.
        depth: (K, P) of the fragments.
        normal: (K, 3) view space.
        near: view depth.
    """
    used = 1 - light
    none = depth.new_zeros(1, depth.shape[1])
    place = torch.arange(1, len(depth) + 1, device=depth.device)[:, None]
    last = torch.cat([none.long(), place * (drawn & (light.detach() > 0.5))]).amax(dim=0)
    median = torch.cat([none, depth]).gather(0, last[None])[0]
    m = FAR / (FAR - near) * (1 - near / depth)
    first, second = m * weights, m * m * weights
    before = [each.cumsum(dim=0) - each for each in (first, second)]
    distortion = weights * (m * m * used + before[1] - 2 * m * before[0])
    sums = (weights * depth).sum(dim=0), normal.mT @ weights, median, distortion.sum(dim=0)
    return torch.cat([each.reshape(-1, weights.shape[1]) for each in sums])
