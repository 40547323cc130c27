"""3D covariances and their projections (EWA splatting)."""

from __future__ import annotations

import torch
from torch import Tensor

from reference_renderer.scene import Camera, Gaussians

FRUSTUM_MARGIN = 1.3
"""The Jacobian is taken no further out than this many times the half field of view."""


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """(N, 3, 3) from (N, 4) w, x, y, z, used as given: not a rotation unless of unit length."""
    w, x, y, z = quaternions.unbind(-1)
    entries = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(entries, dim=-1).reshape(-1, 3, 3)


def covariances(gaussians: Gaussians, scale_modifier: float) -> Tensor:
    """(N, 3, 3) symmetric, R S S R^T, or cov3d unpacked; world units^2."""
    if gaussians.cov3d is not None:
        rows = [gaussians.cov3d[:, i] for i in (0, 1, 2, 1, 3, 4, 2, 4, 5)]
        return torch.stack(rows, dim=-1).reshape(-1, 3, 3)
    if gaussians.scales is None or gaussians.rotations is None:
        raise ValueError("Gaussians: neither cov3d nor scales and rotations are given")
    axes = rotation_matrices(gaussians.rotations) * (scale_modifier * gaussians.scales)[:, None, :]
    return axes @ axes.mT


def clamp_to_frustum(lateral: Tensor, depth: Tensor, tan_fov: float) -> Tensor:
    """(N,) lateral view coordinate, with lateral/depth clamped; a constant where clamped.

    The host's backward pass gives no gradient through a clamped coordinate, not even to the depth.
    """
    limit = FRUSTUM_MARGIN * tan_fov
    slope = lateral / depth
    return torch.where(slope.abs() > limit, (slope.clamp(-limit, limit) * depth).detach(), lateral)


def jacobians(camera: Camera, points: Tensor) -> Tensor:
    """(N, 2, 3) derivative of pixel coordinates by view coordinates at points (N, 3)."""
    x, y, z = points.unbind(-1)
    focal_x = camera.width / (2 * camera.tan_fov_x)
    focal_y = camera.height / (2 * camera.tan_fov_y)
    x = clamp_to_frustum(x, z, camera.tan_fov_x)
    y = clamp_to_frustum(y, z, camera.tan_fov_y)
    zero = torch.zeros_like(z)
    entries = [
        *(focal_x / z, zero, -focal_x * x / (z * z)),
        *(zero, focal_y / z, -focal_y * y / (z * z)),
    ]
    return torch.stack(entries, dim=-1).reshape(-1, 2, 3)


def project_covariances(camera: Camera, points: Tensor, cov3d: Tensor) -> Tensor:
    """(N, 3) image covariances xx, xy, yy in pixels^2, before dilation.

    Args:
        camera: whose rotation turns the covariances into view space.
        points: (N, 3) view space.
        cov3d: (N, 3, 3) world space.
    """
    to_image = jacobians(camera, points) @ camera.viewmatrix[:3, :3].mT
    cov2d = to_image @ cov3d @ to_image.mT
    return torch.stack([cov2d[:, 0, 0], cov2d[:, 0, 1], cov2d[:, 1, 1]], dim=-1)
