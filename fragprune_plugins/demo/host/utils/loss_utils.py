"""L1, SSIM, PSNR."""

import torch
from torch.nn.functional import conv2d


def l1_loss(image, truth):
    """Mean absolute difference."""
    return (image - truth).abs().mean()


def psnr(image, truth):
    """Decibels, of images in [0, 1]."""
    return -10 * torch.log10(((image - truth) ** 2).mean())


def ssim(image, truth, window_size=11, sigma=1.5):
    """Structural similarity of images (C, H, W), zero-padded Gaussian window, mean over pixels."""
    at = torch.arange(window_size, device=image.device, dtype=image.dtype) - window_size // 2
    window = torch.exp(-(at**2) / (2 * sigma**2))
    window = (window / window.sum()).view(1, 1, 1, -1)

    def blur(maps):
        maps = conv2d(maps[:, None], window, padding=(0, window_size // 2))
        return conv2d(maps, window.transpose(2, 3), padding=(window_size // 2, 0))[:, 0]

    maps = torch.cat([image, truth, image * image, truth * truth, image * truth])
    mean_a, mean_b, aa, bb, ab = blur(maps).split(len(image))
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    covariance, variances = ab - mean_a * mean_b, aa - mean_a**2 + bb - mean_b**2
    return (luminance * (2 * covariance + c2) / (variances + c2)).mean()
