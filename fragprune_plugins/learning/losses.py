"""Structural similarity as descendants of 3DGS have it in their loss, 0.8 L1 + 0.2 (1 - SSIM)."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor
from torch.nn.functional import conv2d

WINDOW = 11
SIGMA = 1.5
SSIM_WEIGHT = 0.2

_C1, _C2 = 0.01**2, 0.03**2


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """(C, H, W) structural similarity at each pixel of two images in [0, 1]; differentiable.

    An 11x11 Gaussian window of sigma 1.5, zero padding at the border as in the hosts' loss. For a
    figure to quote use ``figures.metrics.ssim``, which leaves the border out.
    """
    maps = torch.stack([image, target, image * image, target * target, image * target])
    mu_x, mu_y, xx, yy, xy = _blur(maps)
    var_x, var_y, cov = xx - mu_x * mu_x, yy - mu_y * mu_y, xy - mu_x * mu_y
    top = (2 * mu_x * mu_y + _C1) * (2 * cov + _C2)
    bottom = (mu_x * mu_x + mu_y * mu_y + _C1) * (var_x + var_y + _C2)
    similarity: Tensor = top / bottom
    return similarity


@cache
def _window() -> Tensor:
    offsets = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    return torch.softmax(-offsets.square() / (2 * SIGMA**2), dim=0)


def _blur(maps: Tensor) -> Tensor:
    """Convolve (M, C, H, W) with the window, separably: 22 taps a pixel instead of 121."""
    m, c, h, w = maps.shape
    planes = m * c
    window = _window().to(maps).expand(planes, 1, WINDOW)
    pad = WINDOW // 2
    # One group a plane: ten times faster on a CPU than the planes as a batch.
    flat = maps.reshape(1, planes, h, w)
    flat = conv2d(flat, window[:, :, None, :], padding=(0, pad), groups=planes)
    flat = conv2d(flat, window[:, :, :, None], padding=(pad, 0), groups=planes)
    return flat.view(m, c, h, w)
