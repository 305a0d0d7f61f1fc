"""Image metrics: photometric loss, structural similarity, PSNR."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

_SSIM_WINDOW = 7
"""Side of the windows of structural similarity [px]; `_sums_along` adds up seven."""


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """Return the structural similarity at each pixel (H, W), over windows of 7 x 7 (Wang et al. 2004)."""
    a, b = image.permute(2, 0, 1), target.permute(2, 0, 1)
    # apart, as the target mostly has no derivative
    mean_a, aa, ab = _window_means(torch.stack([a, a * a, a * b])).unbind(0)
    mean_b, bb = _window_means(torch.stack([b, b * b])).unbind(0)
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    structure = (2 * (ab - mean_a * mean_b) + c2) / (aa - mean_a**2 + bb - mean_b**2 + c2)
    return (luminance * structure).mean(0)


def _window_means(values: Tensor) -> Tensor:
    """Return the means of values (..., H, W) over the windows about each pixel, as far as they are in the image.

    On a CPU pooling takes five times as long as the additions, each of which would be a launch on a GPU.
    """
    if values.is_cuda:
        return functional.avg_pool2d(values, _SSIM_WINDOW, 1, _SSIM_WINDOW // 2, count_include_pad=False)
    height, width = values.shape[-2:]
    # how many pixels of a window are in the image: rows times columns
    inside = _sums_along(values.new_ones(height, 1), -2) * _sums_along(values.new_ones(1, width), -1)
    return _WindowSums.apply(values) / inside  # type: ignore[operator]


class _WindowSums(torch.autograd.Function):
    """Sums over windows; a pixel is in the windows of those that are in its own, so the derivative is the same sum."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        del ctx
        return _window_sums(values)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        del ctx
        return _window_sums(gradients[0])


def _window_sums(values: Tensor) -> Tensor:
    """Return the sums of values (..., H, W) over the windows about each pixel, with 0 outside of the image."""
    return _sums_along(_sums_along(values, -1), -2)


def _sums_along(values: Tensor, dim: int) -> Tensor:
    """Return the sums of seven neighbours along a dimension, with 0 outside: of pairs, and of pairs of these."""
    count, side = values.shape[dim], _SSIM_WINDOW // 2
    wide = functional.pad(values, (side, side) if dim == -1 else (0, 0, side, side))
    pairs = wide.narrow(dim, 0, count + 5) + wide.narrow(dim, 1, count + 5)
    fours = pairs.narrow(dim, 0, count) + pairs.narrow(dim, 2, count)
    return fours.add_(pairs.narrow(dim, 4, count)).add_(wide.narrow(dim, 6, count))


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
