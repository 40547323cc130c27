"""The training loss against scikit-image and against its own definition."""

import pytest
import torch
from skimage.metrics import structural_similarity
from torch.nn.functional import conv2d

from fragprune_plugins.learning.losses import ssim_map
from fragprune_plugins.workbench.finetune.losses import photometric_loss


@pytest.fixture
def pair():
    stream = torch.Generator().manual_seed(0)
    target = torch.rand(3, 48, 40, generator=stream)
    noise = torch.randn(3, 48, 40, generator=stream)
    return (target + 0.1 * noise).clamp(0, 1), target


def plain_ssim(x, y):
    """The 121 taps written out."""
    offsets = torch.arange(11).double() - 5
    line = torch.exp(-(offsets**2) / 4.5)
    window = torch.outer(line, line)
    window = (window / window.sum())[None, None]

    def blur(z):
        return conv2d(z[:, None], window, padding=5)[:, 0]

    mx, my = blur(x), blur(y)
    vx, vy, c = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    below = (mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4)
    return ((2 * mx * my + 1e-4) * (2 * c + 9e-4) / below).mean()


def test_ssim_is_its_definition(pair):
    x, y = (z.double() for z in pair)
    torch.testing.assert_close(ssim_map(x, y).mean(), plain_ssim(x, y))
    assert float(photometric_loss(y, y)) == pytest.approx(0, abs=1e-6)  # equal images lose nothing
    single = ssim_map(*pair).mean().double()
    torch.testing.assert_close(single, plain_ssim(x, y), rtol=1e-5, atol=1e-5)


def test_ssim_agrees_with_scikit_image_inside(pair):
    """Far from the border the paddings do not differ: a border of equal pixels adds none."""
    x, y = (z.double() for z in pair)
    how = {"channel_axis": -1, "data_range": 1.0, "gaussian_weights": True, "sigma": 1.5}
    given = (z.permute(1, 2, 0).numpy() for z in (x, y))
    _, theirs = structural_similarity(*given, **how, use_sample_covariance=False, full=True)
    ours, inside = ssim_map(x, y).permute(1, 2, 0).numpy(), slice(10, -10)
    assert ours[inside, inside] == pytest.approx(theirs[inside, inside], abs=1e-9)
