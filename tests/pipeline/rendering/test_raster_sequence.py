"""The sequence of the renderer's CUDA kernels, each done by torch: it equals the torch renderer without any GPU."""

from __future__ import annotations

import pytest
import torch
from cgwm.pipeline.rendering import rasterize as module
from cgwm.pipeline.rendering.rasterize import Raster, rasterize
from cgwm.pipeline.rendering.render import render
from helpers import raster_kernels
from pipeline.rendering.test_render import SKEWED, scene, wide_scene

SIZE = (21, 11)  # two tiles, of which one is cut


@pytest.fixture(autouse=True)
def kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "launch", raster_kernels.launch)


def compared(arguments, size=SIZE, channels=3, min_alpha=1 / 255, distortion=None, by_camera=False, moved=False):
    """Compare pictures, and gradients where there are any, of the sequence with those of the torch renderer."""
    generator = torch.Generator().manual_seed(3)
    means, scales, opacities, _, viewmats, Ks = arguments
    shape = (len(Ks), len(means), channels) if by_camera else (len(means), channels)
    features = torch.rand(shape, generator=generator, dtype=torch.float64)
    if moved:
        means = means + 0.03 * torch.arange(len(Ks), dtype=torch.float64)[:, None, None]
    weights = torch.randn(len(Ks), size[1], size[0], channels + 2, generator=generator, dtype=torch.float64)
    results = []
    for exact in (True, False):
        leaves = [means, scales, opacities, features, viewmats]
        leaves = [(leaf if exact else leaf.float()).detach().clone().requires_grad_(not by_camera) for leaf in leaves]
        if exact:
            seen = render(*leaves, Ks, *size, None, distortion, min_alpha=min_alpha, min_transmittance=0.0, median=True)
            outputs = (seen.features, seen.alpha, seen.depth * seen.alpha, seen.median_depth)
        else:
            single = None if distortion is None else distortion.float()
            *outputs, pairs = rasterize(*leaves, Ks.float(), Raster(*size, min_alpha, 0.0), single)
            assert not outputs[3].requires_grad and not pairs.requires_grad
        gradients = []
        if not by_camera:
            parts = torch.cat([outputs[0], *(o[..., None] for o in outputs[1:3])], -1)
            gradients = torch.autograd.grad((parts * weights.to(parts)).sum(), leaves[: 4 if moved else 5])
        results.append(([value.detach().double() for value in outputs], [value.double() for value in gradients]))
    (outputs, gradients), (mine, my_gradients) = results
    for exact, single in zip(outputs, mine, strict=True):
        assert int(((exact - single).abs() > 5e-5 * exact.abs().clamp_min(1)).sum()) <= 1
    for exact, single in zip(gradients, my_gradients, strict=True):
        assert (exact - single).norm() <= 2e-4 * exact.norm() + 1e-7


@pytest.mark.parametrize("channels", [3, 9])
def test_the_sequence_of_kernels_gives_pictures_and_gradients(channels):
    compared(scene(9), channels=channels)


def test_several_rows_of_tiles_of_three_cameras():
    means, scales, opacities, features, viewmats, Ks = scene(8, cameras=3)
    compared((means, scales, opacities, features, viewmats, 1.4 * Ks), size=(35, 20))


def test_distorted_rays_are_traced_for_each_camera():
    arguments, distortion = wide_scene(9, *SIZE)
    compared(arguments, distortion=distortion)
    compared(scene(6), distortion=torch.tensor(SKEWED[:4], dtype=torch.float64))  # four terms for all cameras


def test_features_and_means_may_differ_by_camera():
    compared(scene(9), by_camera=True)
    compared(scene(9), moved=True)
    means, scales, opacities, features, viewmats, Ks = [value.float() for value in scene(3)]
    with pytest.raises(ValueError, match="have no derivative on CUDA"):
        rasterize(
            means.requires_grad_(), scales, opacities, features.expand(2, -1, -1), viewmats, Ks, Raster(*SIZE, 0.0, 0.0)
        )


def test_a_capacity_holds_the_nearest_pairs_and_no_sphere_is_nothing():
    arguments = [value.float() for value in scene(12)]
    counted = rasterize(*arguments, Raster(*SIZE, 1 / 255, 1e-4))
    roomy = rasterize(*arguments, Raster(*SIZE, 1 / 255, 1e-4, capacity=2 * int(counted[4])))
    for one, other in zip(counted, roomy, strict=True):
        torch.testing.assert_close(one, other, atol=0, rtol=0)
    small = rasterize(*arguments, Raster(*SIZE, 1 / 255, 1e-4, capacity=int(counted[4]) // 2))
    assert int(small[4]) == int(counted[4]) and float((small[1] - counted[1]).max()) < 1e-5
    assert float((small[1] - counted[1]).abs().max()) > 0.01
    none = [value[:0].requires_grad_() for value in arguments[:4]]
    picture, alpha, depth, median, pairs = rasterize(*none, *arguments[4:], Raster(*SIZE, 1 / 255, 0.0))
    assert not picture.any() and not alpha.any() and not depth.any() and not median.any() and int(pairs) == 0
    assert picture.shape == (2, 11, 21, 3) and torch.autograd.grad(picture.sum() + alpha.sum(), none)[0].shape == (0, 3)


def test_keys_of_tiles_have_16_bits_while_these_suffice():
    """Many tiny tiles of nothing but two spheres: the first and the last tile of all cameras are found."""
    means, scales, opacities, features, viewmats, Ks = [value.float() for value in scene(2, cameras=1)]
    for tiles in (2**15 - 1, 2**15):
        kinds = []

        def noted(name, device, count, tensors, numbers, kinds=kinds, **defines):
            if name == "emit":
                kinds.append((tensors[-2].dtype, numbers[-1]))
            if name in ("project", "emit"):
                raster_kernels.launch(name, device, count, tensors, numbers, **defines)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, "launch", noted)
            rasterize(means, scales, opacities, features, viewmats, Ks, Raster(16 * tiles, 11, 1 / 255, 0.0))
        assert kinds == [(torch.int16, 0) if tiles < 2**15 else (torch.int32, 1)]
