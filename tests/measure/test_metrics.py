"""Image quality figures."""

from __future__ import annotations

import math

import pytest
import torch

from fragprune_plugins.errors import InputError
from fragprune_plugins.measure import lpips, psnr, ssim


def test_psnr_of_a_known_error():
    target = torch.full((3, 16, 16), 0.5)
    assert psnr(target + 0.1, target) == pytest.approx(20.0, abs=1e-4)
    assert psnr(target, target) == math.inf


def test_images_are_clamped_first():
    white = torch.ones(3, 16, 16)
    assert psnr(3 * white, white) == math.inf
    assert ssim(3 * white, white) == 1


def test_ssim_orders_noise():
    stream = torch.Generator().manual_seed(0)
    target = torch.rand(3, 24, 20, generator=stream)
    noise = torch.randn(3, 24, 20, generator=stream)
    values = [ssim(target + scale * noise, target) for scale in (0.0, 0.05, 0.3)]
    assert values[0] == pytest.approx(1)
    assert values[0] > values[1] > values[2]


def test_ssim_needs_a_window():
    with pytest.raises(InputError, match="at least 11x11"):
        ssim(torch.zeros(3, 8, 20), torch.zeros(3, 8, 20))


def test_lpips_is_never_made_up():
    assert lpips(torch.zeros(3, 16, 16), torch.zeros(3, 16, 16)) is None
