"""Image quality of one image against its photograph. Images are clamped to [0, 1] first."""

from __future__ import annotations

from torch import Tensor

from fragprune_plugins.errors import InputError
from fragprune_plugins.learning.losses import SIGMA, WINDOW


def psnr(image: Tensor, target: Tensor) -> float:
    """Peak signal-to-noise ratio, dB, data range 1; infinite for equal images (3, H, W)."""
    mse = (image.clamp(0, 1) - target.clamp(0, 1)).square().mean().double()
    return float(-10 * mse.log10())


def ssim(image: Tensor, target: Tensor) -> float:
    """Structural similarity by scikit-image, in [-1, 1], of two images (3, H, W).

    The hosts' parameters: Gaussian window of sigma 1.5 (11 pixels), population covariance, data
    range 1, mean over channels. Pixels within 5 of the border are left out; the hosts' zero-padded
    version counts them.

    Raises:
        InputError: an image smaller than the window.
    """
    from skimage.metrics import structural_similarity

    if min(image.shape[-2:]) < WINDOW:
        raise InputError(
            "ssim",
            f"an image of {image.shape[-1]}x{image.shape[-2]} pixels",
            f"at least {WINDOW}x{WINDOW}",
            "Measure on larger images.",
        )
    first, second = (
        x.detach().clamp(0, 1).permute(1, 2, 0).cpu().double().numpy() for x in (image, target)
    )
    return float(
        structural_similarity(  # type: ignore[no-untyped-call]
            first,
            second,
            channel_axis=-1,
            data_range=1.0,
            gaussian_weights=True,
            sigma=SIGMA,
            use_sample_covariance=False,
        )
    )


def lpips(image: Tensor, target: Tensor) -> None:
    """Not computed, because LPIPS needs network weights from a download.

    Reports carry ``null``. To compute LPIPS, render both models with ``fragprune render`` and run
    the ``lpips`` package on the pictures.
    """
