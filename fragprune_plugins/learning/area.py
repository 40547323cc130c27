"""The area that viewers without thresholds rasterize, as a function that learning can descend on.

Most web viewers draw a quad around a Gaussian's ellipse of sqrt(8) standard deviations, however
faint it is (antimatter15/splat, GaussianSplats3D, Spark, Babylon.js). The area of the quads is most
of what a frame costs there. It is 4 / pi times that of the ellipses.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import torch
from torch import Tensor

from fragprune_plugins.constants import FRUSTUM_MARGIN
from fragprune_plugins.types import Splats

if TYPE_CHECKING:
    from fragprune_plugins.types import Footprints, RasterInputs, View

SQUARED_RADIUS: Final = 8.0  # of the ellipses, in standard deviations; exp(-8 / 2) is left


def ellipse_areas(inputs: RasterInputs) -> Tensor:
    """(N,) pixels of the picture that lie in each Gaussian's ellipse; 0 behind the near plane.

    Opacities, thresholds, compensation and sample offsets have no part in it. At the picture's edge
    an ellipse counts with the share of its bounding box that the picture shows. Shapes get
    gradients; positions get none, for it would be cheapest to leave the picture.
    """
    view, splats = inputs.view, inputs.splats
    if isinstance(splats, Splats):
        cov2d, means2d, visible = project(inputs, splats)
    else:
        cov2d, means2d, visible = _invert(splats)
    xx, xy, yy = cov2d
    whole = math.pi * SQUARED_RADIUS * (xx * yy - xy * xy).clamp_min(1e-12).sqrt()
    shown = _shown(means2d[:, 0], xx, view.width) * _shown(means2d[:, 1], yy, view.height)
    return torch.where(visible, whole * shown, 0.0)


def area_per_pixel(inputs: RasterInputs) -> Tensor:
    """Scalar: the sum of ``ellipse_areas`` over the picture's pixels."""
    return ellipse_areas(inputs).sum() / (inputs.view.width * inputs.view.height)


def _shown(centre: Tensor, variance: Tensor, size: int) -> Tensor:
    """(N,) share of intervals around centres (N,) in pixels that lies on an axis of the picture."""
    half = (SQUARED_RADIUS * variance).sqrt()
    last, first = (centre + half).clamp_max(size - 0.5), (centre - half).clamp_min(-0.5)
    return (last - first).clamp_min(0) / (2 * half)


def _invert(footprints: Footprints) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor, Tensor]:
    """Covariances and means of projected Gaussians, and whether they are drawn."""
    xx, xy, yy = footprints.conics.unbind(-1)
    det = xx * yy - xy * xy
    x0, y0, x1, y1 = footprints.tiles.unbind(-1)
    drawn = (det > 0) & (footprints.depths > 0) & (x1 > x0) & (y1 > y0)
    det = torch.where(drawn, det, 1.0)
    one = torch.ones_like(xx)
    cov2d = tuple(torch.where(drawn, each / det, one) for each in (yy, -xy, xx))
    return cov2d, footprints.means2d.detach(), drawn  # type: ignore[return-value]


def project(
    inputs: RasterInputs, splats: Splats
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor, Tensor]:
    """Covariances and means on the image, and whether the Gaussians lie in front of the camera."""
    view, means = inputs.view, splats.means.detach()
    points = means @ view.viewmatrix[:3, :3] + view.viewmatrix[3, :3]
    visible = points[:, 2] > inputs.near
    depth = torch.where(visible, points[:, 2], 1.0)
    across, down = _axes(view, points, depth)
    if splats.cov3d is not None:
        xx, xy, yy = (
            _quadratic(splats.cov3d, one, other)
            for one, other in ((across, across), (across, down), (down, down))
        )
    else:
        assert splats.scales is not None
        assert splats.rotations is not None
        lengths = inputs.scale_modifier * splats.scales
        columns = rotations(splats.rotations)
        a = lengths * (across[:, :, None] * columns).sum(1)
        b = lengths * (down[:, :, None] * columns).sum(1)
        xx, xy, yy = (a * a).sum(-1), (a * b).sum(-1), (b * b).sum(-1)
    clip = means @ view.projmatrix[:3] + view.projmatrix[3]
    size = means.new_tensor([view.width, view.height])
    means2d = ((clip[:, :2] / (clip[:, 3:] + 1e-7) + 1) * size - 1) / 2
    return (xx + inputs.dilation, xy, yy + inputs.dilation), means2d, visible


def _axes(view: View, points: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """(N, 3) each: derivatives of a pixel's x and y by world coordinates, as 3DGS clamps them."""
    rotation, axes = view.viewmatrix[:3, :3], []
    for axis, size, tan in ((0, view.width, view.tan_fov_x), (1, view.height, view.tan_fov_y)):
        limit = FRUSTUM_MARGIN * tan
        slope = (points[:, axis] / depth).clamp(-limit, limit)[:, None]
        focal = size / (2 * tan) / depth[:, None]
        axes.append(focal * (rotation[:, axis] - slope * rotation[:, 2]))
    return axes[0], axes[1]


def _quadratic(cov3d: Tensor, one: Tensor, other: Tensor) -> Tensor:
    """(N,) one^T C other, of upper triangles C (N, 6) and vectors (N, 3)."""
    xx, xy, xz, yy, yz, zz = cov3d.unbind(-1)
    rows = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
    terms = (one[:, i] * rows[i][j] * other[:, j] for i in range(3) for j in range(3))
    return torch.stack(tuple(terms)).sum(0)


def rotations(quaternions: Tensor) -> Tensor:
    """(N, 3, 3) from w, x, y, z (N, 4), used as given."""
    w, x, y, z = quaternions.unbind(-1)
    entries = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack(entries, -1).reshape(-1, 3, 3)
