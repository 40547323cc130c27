"""``render_depth``: where each pixel's ray passes the Gaussian with the largest weight.

The host places new points there. For a Gaussian of mean m, rotation R and scales s it takes the
ellipsoid at three scales, and the middle of the ray's path through it. With W = diag(1 / 3s) R^T
and a ray o + t d, where d has view depth 1, the middle is at t = -(W d)(W (o - m)) / |W d|^2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from fragprune_plugins.adapting import (
    InputError,
    RasterInputs,
    RasterOutputs,
    Splats,
    View,
    rotations,
)

if TYPE_CHECKING:
    from torch import Tensor


TILE = 16  # pixels; a Gaussian reaches at most its radius and the rest of a tile


@torch.no_grad()
def render_depth(
    inputs: RasterInputs, draw: Callable[[RasterInputs], RasterOutputs]
) -> dict[str, Tensor]:
    """Draw the host's six pictures of one view, with scores.

    If the middle is behind the camera, the host's fragment colours the pixel, but does not win it
    and does not hide later fragments. This finds such fragments and draws their pixels again
    without them. Winner and transmittance are then the host's; only ``render`` lacks the colour of
    these fragments.

    Returns:
        ``render`` (3, H, W), ``out_pts`` (3, H, W) world, ``rendered_depth``, ``discriminants`` and
        ``accum_alpha`` (1, H, W), which is the remaining transmittance despite its name, and
        ``gidx`` (1, H, W) int32. Pixels without fragments have zeros, and a transmittance of 1.

    Raises:
        InputError: the host passed covariances instead of scales and rotations.
    """
    splats = inputs.splats
    assert isinstance(splats, Splats)  # what unpack makes of the host's call
    if splats.scales is None or splats.rotations is None:
        found = "precomputed covariances"
        expected = "scales and rotations, which the host's own rasterizer reads here"
        raise InputError("render_depth", found, expected, "Leave out --compute_cov3D_python.")
    inputs = replace(inputs, planes=("alpha",))
    drawn = draw(inputs)
    winners, left, image = drawn.winners, 1 - drawn.alpha[0], drawn.image
    assert winners is not None  # scores were asked for
    directions = _directions(inputs.view)
    # the world to a frame where the ellipsoid at three scales is the unit sphere
    whiten = rotations(splats.rotations.double()).mT / (3 * splats.scales.double()[:, :, None])
    offset = inputs.view.campos.double() - splats.means.double()  # (N, 3) from the mean to the eye
    start = (whiten @ offset[:, :, None])[:, :, 0]
    normals = (whiten.transpose(1, 2) @ start[:, :, None])[:, :, 0]
    behind = _behind(inputs.view, splats.means, drawn.radii, directions, normals)
    for rows, where in behind:
        opacities = splats.opacities.clone()
        opacities[rows] = 0.0
        again = draw(replace(inputs, splats=replace(splats, opacities=opacities)))
        assert again.winners is not None
        winners = torch.where(where, again.winners, winners)
        left = torch.where(where, 1 - again.alpha[0], left)
        image = torch.where(where, again.image, image)
    won = winners >= 0
    rows = winners.clamp_min(0).long()
    along = (whiten[rows] @ directions[..., None])[..., 0]
    begin = start[rows]
    a, b = along.square().sum(-1), (along * begin).sum(-1)
    c = begin.square().sum(-1) - 1
    depth = torch.where(won, -b / a, 0)
    points = inputs.view.campos.double() + depth[..., None] * directions
    discriminant = 4 * (b * b - a * c) / directions.square().sum(-1)
    return {
        "render": image,
        "out_pts": torch.where(won[..., None], points, 0).permute(2, 0, 1).float(),
        "rendered_depth": depth[None].float(),
        "discriminants": torch.where(won, discriminant, 0)[None].float(),
        "gidx": rows[None].int(),
        "accum_alpha": left[None],
    }


def _directions(view: View) -> Tensor:
    """(H, W, 3) float64: from the eye to the pixels' centres at view depth 1, in the world."""
    turn = view.viewmatrix[:3, :3].double().T
    x = (2 * torch.arange(view.width, device=turn.device).double() + 1) / view.width - 1
    y = (2 * torch.arange(view.height, device=turn.device).double() + 1) / view.height - 1
    rows, columns = torch.meshgrid(y * view.tan_fov_y, x * view.tan_fov_x, indexing="ij")
    camera = torch.stack([columns, rows, torch.ones_like(rows)], dim=-1)
    return camera @ turn


def _behind(
    view: View, means: Tensor, radii: Tensor, directions: Tensor, normals: Tensor
) -> list[tuple[Tensor, Tensor]]:
    """Find the Gaussians whose middles are behind the camera, and at which pixels.

    t is negative where the ray's direction has a positive product with a vector of the Gaussian: in
    a half plane of the image. A linear function is largest at a corner of the image, so four
    products rule out nearly all Gaussians.

    Returns:
        (rows (M,), where (H, W) bool): pixels at which exactly these rows are to be left out.
    """
    height, width = directions.shape[:2]
    corners = directions[:: max(1, height - 1), :: max(1, width - 1)].reshape(-1, 3)
    rows = ((corners @ normals.T > 0).any(dim=0) & (radii > 0)).nonzero()[:, 0]
    if not len(rows):
        return []
    clip = torch.nn.functional.pad(means[rows], (0, 1), value=1.0) @ view.projmatrix
    ndc = clip[:, :2] / (clip[:, 3:] + 1e-7)
    reach = radii[rows] + TILE
    x, y = ((ndc[:, 0] + 1) * width - 1) / 2, ((ndc[:, 1] + 1) * height - 1) / 2
    columns = torch.arange(width, device=x.device)[:, None]
    lines = torch.arange(height, device=x.device)[:, None]
    touched = ((lines - y).abs() <= reach)[:, None] & ((columns - x).abs() <= reach)[None]
    behind = touched & (directions @ normals[rows].T > 0)  # (H, W, M)
    patterns, kind = torch.unique(behind.reshape(-1, len(rows)), dim=0, return_inverse=True)
    kind = kind.reshape(height, width)
    return [(rows[p], kind == i) for i, p in enumerate(patterns) if bool(p.any())]
