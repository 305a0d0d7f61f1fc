"""Image errors against values that are known, and against sums over windows written out."""

import numpy as np
import pytest
import torch
from cgwm.pipeline.rendering.image_metrics import photometric, psnr, ssim_map


def test_a_tenth_everywhere_is_twenty_decibel() -> None:
    image = torch.full((12, 9, 3), 0.4)
    chosen = torch.zeros(12, 9, dtype=torch.bool)
    chosen[:3] = True
    other = image + torch.where(chosen, 0.01, 0.1)[..., None]
    assert psnr(image, image + 0.1) == pytest.approx(20, abs=1e-4)
    assert psnr(image, other, chosen) == pytest.approx(40, abs=1e-3)
    assert psnr(image, image) == pytest.approx(100), "a limit for equal images"


def test_similarity_is_the_formula_of_wang_over_whole_windows() -> None:
    """SSIM of Wang et al. (2004), equation 13, with box windows of which only the part inside of the image counts."""
    rng = np.random.default_rng(0)
    a, b = rng.random((2, 16, 13, 3))
    found = ssim_map(torch.tensor(a), torch.tensor(b)).numpy()
    flat = ssim_map(torch.zeros(25, 25, 3), torch.ones(25, 25, 3))[12, 12]
    assert float(flat) == pytest.approx(1e-4 / (1 + 1e-4)), "black against white: luminance alone, c1 / (1 + c1)"
    half = next(h for h in range(1, 12) if _ssim(a, b, 8, 6, h) == pytest.approx(found[8, 6], abs=1e-9))
    for row, column in ((0, 0), (15, 12), (3, 11), (7, 0)):
        assert found[row, column] == pytest.approx(_ssim(a, b, row, column, half), abs=1e-9)


def test_loss_weighs_pixels_and_mixes_both_parts() -> None:
    rng = np.random.default_rng(1)
    a, b = torch.tensor(rng.random((2, 15, 15, 3)))
    absolute = (a - b).abs().mean(-1)
    expected = 0.8 * absolute + 0.2 * 0.5 * (1 - ssim_map(a, b))
    one = torch.zeros(15, 15, dtype=a.dtype)
    one[4, 5] = one[10, 2] = 1.0
    assert float(photometric(a, b)) == pytest.approx(float(expected.mean()))
    assert float(photometric(a, b, one)) == pytest.approx(float(expected[4, 5] + expected[10, 2]) / 2)


def test_derivative_of_the_similarity_equals_differences() -> None:
    a, b = torch.tensor(np.random.default_rng(2).random((2, 8, 9, 2)))
    assert torch.autograd.gradcheck(ssim_map, (a.requires_grad_(), b.requires_grad_()))


def _ssim(a: np.ndarray, b: np.ndarray, row: int, column: int, half: int) -> float:
    at = np.s_[max(row - half, 0) : row + half + 1, max(column - half, 0) : column + half + 1]
    values = []
    for x, y in zip(a[at].reshape(-1, 3).T, b[at].reshape(-1, 3).T, strict=True):
        mx, my, xx, yy, xy = x.mean(), y.mean(), x.var(), y.var(), ((x - x.mean()) * (y - y.mean())).mean()
        top = (2 * mx * my + 0.01**2) * (2 * xy + 0.03**2)
        values.append(top / ((mx**2 + my**2 + 0.01**2) * (xx + yy + 0.03**2)))
    return float(np.mean(values))


def test_the_loss_of_one_pixel_is_its_own_and_little_weight_counts_little() -> None:
    image, target = torch.rand(2, 9, 9, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    one = torch.zeros(9, 9, dtype=torch.float64)
    one[4, 3] = 1.0
    alone = 0.2 * 0.5 * (1 - ssim_map(image, target)[4, 3]) + 0.8 * (image - target)[4, 3].abs().mean()
    assert photometric(image, target, one).item() == pytest.approx(alone.item(), rel=1e-12)
    assert photometric(image, target, 3 * one).item() == pytest.approx(alone.item(), rel=1e-12)
    assert photometric(image, target, 0.5 * one).item() == pytest.approx(0.5 * alone.item(), rel=1e-12)
