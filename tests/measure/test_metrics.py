"""Image quality figures."""

import math
import sys
from types import SimpleNamespace

import pytest
import torch

from fragprune_plugins.errors import InputError
from fragprune_plugins.workbench.figures import metrics
from fragprune_plugins.workbench.figures.metrics import lpips, psnr, ssim


def test_psnr_of_a_known_error():
    target = torch.full((3, 16, 16), 0.5)
    assert psnr(target + 0.1, target) == pytest.approx(20.0, abs=1e-4)
    assert psnr(target, target) == math.inf
    assert psnr(target + 9, 2 * target) == math.inf  # images are clamped first


def test_ssim_orders_noise_and_needs_a_window():
    stream = torch.Generator().manual_seed(0)
    target = torch.rand(3, 24, 20, generator=stream)
    noise = torch.randn(3, 24, 20, generator=stream)
    values = [ssim(target + scale * noise, target) for scale in (0.0, 0.05, 0.3)]
    assert values[0] == pytest.approx(1)
    assert values[0] > values[1] > values[2]
    white = torch.ones(3, 16, 16)
    assert ssim(3 * white, white) == 1  # clamped first
    with pytest.raises(InputError, match="at least 11x11"):
        ssim(white[:, :8], white[:, :8])


class Network(torch.nn.Module):
    """Stands in for the package's: how far two pictures are apart as they come in."""

    def __init__(self, net, verbose):
        super().__init__()
        assert (net, verbose) == ("vgg", False)

    def forward(self, one, other, normalize):
        assert normalize
        assert one.shape == other.shape == (1, 3, 16, 20)
        assert 0 <= float(one.min()) <= float(one.max()) <= 1
        return (one - other).abs().mean()


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache of torch, and no network kept from before."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    metrics._network.cache_clear()
    yield tmp_path / "hub" / "checkpoints"
    metrics._network.cache_clear()


def put_weights(folder):
    folder.mkdir(parents=True)
    (folder / metrics.WEIGHTS).touch()


@pytest.mark.parametrize("installed", [False, True])
def test_lpips_is_never_made_up_and_nothing_is_downloaded(cache, monkeypatch, installed):
    monkeypatch.setitem(sys.modules, "lpips", SimpleNamespace() if installed else None)
    if not installed:
        put_weights(cache)
    assert lpips(torch.zeros(3, 16, 16), torch.zeros(3, 16, 16)) is None


def test_lpips_is_the_packages_where_its_weights_are(cache, monkeypatch):
    monkeypatch.setitem(sys.modules, "lpips", SimpleNamespace(LPIPS=Network))
    put_weights(cache)
    white = 3 * torch.ones(3, 16, 20)
    assert lpips(white, torch.zeros(3, 16, 20)) == 1.0
    assert lpips(white, white) == 0.0
    assert lpips(white[:, :8], white[:, :8]) is None  # too small


@pytest.mark.slow
def test_lpips_of_the_real_package_orders_noise(cache):
    """With VGG16's weights drawn at random: their file is large, and its numbers do not matter."""
    pytest.importorskip("lpips", exc_type=(ImportError, RuntimeError))
    from torchvision.models import vgg16

    cache.mkdir(parents=True)
    torch.manual_seed(0)
    torch.save(vgg16(weights=None).state_dict(), cache / metrics.WEIGHTS)
    stream = torch.Generator().manual_seed(0)
    target, noise = torch.rand(2, 3, 32, 32, generator=stream)
    values = [lpips(target + scale * noise, target) for scale in (0.0, 0.1, 0.5)]
    assert values[0] == pytest.approx(0, abs=1e-6)
    assert values[0] < values[1] < values[2]
