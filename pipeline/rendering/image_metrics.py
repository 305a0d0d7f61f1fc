"""Image metrics: photometric loss, structural similarity, PSNR."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

_SSIM_WINDOW = 7
"""Side of the windows of structural similarity [px]."""


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """Return the structural similarity at each pixel (H, W), over windows of 7 x 7 (Wang et al. 2004)."""

    def mean(values: Tensor) -> Tensor:
        return functional.avg_pool2d(values, _SSIM_WINDOW, 1, _SSIM_WINDOW // 2, count_include_pad=False)

    a, b = image.permute(2, 0, 1), target.permute(2, 0, 1)
    mean_a, mean_b, aa, bb, ab = mean(torch.stack([a, b, a * a, b * b, a * b])).unbind(0)
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    structure = (2 * (ab - mean_a * mean_b) + c2) / (aa - mean_a**2 + bb - mean_b**2 + c2)
    return (luminance * structure).mean(0)


DSSIM_WEIGHT = 0.2
"""Share of D-SSIM in the photometric loss, as in 3D Gaussian splatting (arXiv 2308.04079, equation 7)."""


def photometric(image: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
    """Return (1 - w) L1 + w (1 - SSIM) / 2 of two images (H, W, 3), with optional pixel weights (H, W)."""
    absolute = (image - target).abs().mean(-1)
    similar = 0.5 * (1 - ssim_map(image, target))
    both = (1 - DSSIM_WEIGHT) * absolute + DSSIM_WEIGHT * similar
    return both.mean() if weight is None else (both * weight).sum() / weight.sum().clamp_min(1.0)


@torch.no_grad()
def psnr(image: Tensor, target: Tensor, chosen: Tensor | None = None) -> float:
    """Return the peak signal-to-noise ratio [dB] of values in [0, 1], over chosen pixels (H, W) or all."""
    square = (image - target).square().mean(-1)
    return psnr_of(square.mean() if chosen is None else square[chosen].mean())


def psnr_of(mean_square: Tensor) -> float:
    """Return the peak signal-to-noise ratio [dB] of a mean square error of values in [0, 1]."""
    return float(-10 * torch.log10(mean_square.clamp_min(1e-10)))
