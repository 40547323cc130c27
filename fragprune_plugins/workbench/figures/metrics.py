"""Image quality of one image against its photograph. Images are clamped to [0, 1] first."""

from __future__ import annotations

import math
import statistics
import warnings
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.errors import InputError
from fragprune_plugins.learning.losses import SIGMA, WINDOW

WEIGHTS = "vgg16-397923af.pth"  # of VGG16, in ``checkpoints`` of ``torch.hub.get_dir()``
SMALLEST = 16  # pixels of a side of which VGG16's four poolings leave one


def psnr(image: Tensor, target: Tensor) -> float:
    """Peak signal-to-noise ratio, dB, data range 1; infinite for equal images (3, H, W)."""
    mse = (image.clamp(0, 1) - target.clamp(0, 1)).square().mean().double()
    return float(-10 * mse.log10())


def mean(figures: Sequence[float]) -> float:
    """The mean over views; infinite PSNR, as of views of nothing, counts only where all have it."""
    return statistics.fmean([each for each in figures if each < math.inf] or figures)


def expect_window(image: Tensor) -> None:
    """Raise InputError if an image (3, H, W) is smaller than the window of ``ssim``."""
    if min(image.shape[-2:]) < WINDOW:
        found = f"an image of {image.shape[-1]}x{image.shape[-2]} pixels"
        raise InputError("ssim", found, f"at least {WINDOW}x{WINDOW}", "Measure on larger images.")


def ssim(image: Tensor, target: Tensor) -> float:
    """Structural similarity by scikit-image, in [-1, 1], of two images (3, H, W).

    The hosts' parameters: Gaussian window of sigma 1.5 (11 pixels), population covariance, data
    range 1, mean over channels. Pixels within 5 of the border are left out; the hosts' zero-padded
    version counts them. An image smaller than the window is an InputError.
    """
    from skimage.metrics import structural_similarity

    expect_window(image)
    both = (each.detach().clamp(0, 1).permute(1, 2, 0) for each in (image, target))
    pair = (each.cpu().double().numpy() for each in both)
    how = {"gaussian_weights": True, "sigma": SIGMA, "use_sample_covariance": False}
    similarity: Any = structural_similarity
    return float(similarity(*pair, channel_axis=-1, data_range=1.0, **how))


def lpips(image: Tensor, target: Tensor) -> float | None:
    """Learned perceptual distance with VGG16, 0 for equal images (3, H, W); None if not installed.

    By the package ``lpips`` (0.1.4), from images scaled to [-1, 1] as it was trained on. The hosts'
    own figures differ: 3DGS scales to [0, 1]. Nothing is downloaded: the weights of VGG16 must lie
    in torch's cache (``WEIGHTS``), where the first use of the package puts them. Images below 16x16
    pixels have no features, and so no distance.
    """
    network = _network(image.device)
    if network is None or min(image.shape[-2:]) < SMALLEST:
        return None
    with torch.no_grad():
        pair = (each.detach().float().clamp(0, 1)[None] for each in (image, target))
        return float(network(*pair, normalize=True))


@lru_cache(maxsize=1)
def _network(device: torch.device) -> Callable[..., Tensor] | None:
    """The network of ``lpips``; None if package or weights are missing or cannot be used."""
    if not (Path(torch.hub.get_dir()) / "checkpoints" / WEIGHTS).is_file():
        return None
    try:
        from lpips import LPIPS
    except (ImportError, RuntimeError):  # a torchvision of another torch raises the latter
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it calls torchvision as one did in 2021
        network: Callable[..., Tensor] = LPIPS(net="vgg", verbose=False).to(device).eval()
    return network
