"""The compiled compositing against its twin in torch, and against the laws of its own."""

import pytest
import torch
from cgwm.pipeline.rendering import composite_host, composite_reference
from cgwm.pipeline.rendering.composite_reference import TileLists
from cgwm.pipeline.runtime import kernel_build

pytestmark = pytest.mark.skipif(kernel_build.host_unavailable() is not None, reason="needs a C++ compiler")

LENGTHS = (90, 0, 33, 1, 64)


def tile_lists(pixels=64, dtype=torch.float64, min_alpha=1 / 255, min_transmittance=1e-4):
    """Lists of several lengths, with spheres of all opacities: pairs, channels of their spheres, and the lists."""
    generator = torch.Generator().manual_seed(0)
    count, channels = sum(LENGTHS), 5
    x, y = 0.1 * torch.randn(2, 3, pixels, generator=generator, dtype=torch.float64)
    basis = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], -1) / (1 + x * x + y * y)[..., None]
    places = 0.2 * torch.randn(count, 2, generator=generator, dtype=torch.float64)
    log_opacity = (1.2 * torch.rand(count, generator=generator, dtype=torch.float64)).clamp_max(1).log()
    px, py = places.unbind(1)
    k = torch.full_like(px, -30.0)
    rows = [k * (px**2 + py**2) + log_opacity, -2 * k * px, -2 * k * py]
    rows += [k * (1 + py**2) + log_opacity, -2 * k * px * py, k * (1 + px**2) + log_opacity]
    features = torch.randn(count, channels, generator=generator, dtype=torch.float64)
    counts = torch.tensor(LENGTHS)
    lists = TileLists(
        basis=basis.to(dtype),
        frame=torch.tensor([0, 1, 2, 0, 1]),
        starts=counts.cumsum(0) - counts,
        counts=counts,
        min_alpha=min_alpha,
        min_transmittance=min_transmittance,
    )
    return torch.stack(rows, 1).to(dtype), features.to(dtype), lists


def results_and_gradients(composite, coefficients, features, lists):
    leaves = coefficients.clone().requires_grad_(), features.clone().requires_grad_()
    out, alpha, middle = composite(*leaves, lists, True)
    weights = torch.randn(out.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(out)
    loss = (out * weights).sum() + (alpha * weights[..., 0]).sum()
    return [out.detach(), alpha.detach(), middle, *torch.autograd.grad(loss, leaves)]


@pytest.mark.parametrize("thresholds", [{}, {"min_alpha": 0.0, "min_transmittance": 0.0}])
@pytest.mark.parametrize("pixels", [64, 36])
def test_results_and_gradients_equal_the_twin(pixels, thresholds):
    given = tile_lists(pixels, **thresholds)
    mine = results_and_gradients(composite_host.composite, *given)
    other = results_and_gradients(composite_reference.composite, *given)
    assert other[1].amax() > 1 - 1e-4  # some pixels are full, so that the threshold acts
    torch.testing.assert_close(mine, other, atol=1e-11, rtol=1e-10)


def test_single_precision_equals_double():
    exact = {"min_alpha": 0.0, "min_transmittance": 0.0}  # a threshold may fall between the two
    mine = results_and_gradients(composite_host.composite, *tile_lists(dtype=torch.float32, **exact))
    other = results_and_gradients(composite_reference.composite, *tile_lists(**exact))
    for a, b in zip(mine, other, strict=True):
        torch.testing.assert_close(a.double(), b, atol=2e-5 * float(b.abs().amax()), rtol=0)


def test_pixels_beyond_one_block_are_those_of_smaller_tiles():
    coefficients, features, lists = tile_lists(150, min_transmittance=0.0)
    whole = composite_host.composite(coefficients, features, lists, True)
    for first in range(0, 150, 50):
        part = composite_host.composite(
            coefficients, features, TileLists(**{**vars(lists), "basis": lists.basis[:, first : first + 50]}), True
        )
        for a, b in zip(whole, part, strict=True):
            torch.testing.assert_close(a[:, first : first + 50], b, atol=1e-14, rtol=0)


def test_threads_change_nothing(monkeypatch):
    monkeypatch.setattr(composite_host, "PAIRS_PER_THREAD", 1)
    found = []
    for threads in (1, 3):
        monkeypatch.setattr(composite_host, "kernel_threads", lambda count=threads: count)
        found.append(results_and_gradients(composite_host.composite, *tile_lists()))
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))
