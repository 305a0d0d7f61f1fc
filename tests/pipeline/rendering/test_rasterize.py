"""The CUDA kernels of the renderer against the torch renderer in double precision."""

from __future__ import annotations

import math

import pytest
import torch
from cgwm.pipeline.rendering.rasterize import Raster, rasterize
from cgwm.pipeline.rendering.rays import pixel_rays
from cgwm.pipeline.rendering.render import render
from cgwm.pipeline.runtime import kernel_build
from pipeline.rendering.test_render import BARREL, PINCUSHION, SKEWED, rotation, scene, twin, wide_scene

pytestmark = pytest.mark.skipif(not kernel_build.available(), reason="needs a CUDA device and cuda-core")
DEVICE = "cuda"
SIZE = (21, 11)  # two tiles, of which one is cut


def both(arguments, min_alpha=1 / 255, channels=3, seed=3, size=SIZE, distortion=None):
    """Return outputs and gradients (outputs, gradients) of the torch renderer in double, and of the kernels."""
    generator = torch.Generator().manual_seed(seed)
    means, scales, opacities, features, viewmats, Ks = arguments
    features = torch.rand(len(means), channels, generator=generator, dtype=torch.float64)
    weights = torch.randn(len(Ks), size[1], size[0], channels + 2, generator=generator, dtype=torch.float64)
    results = []
    for exact in (True, False):
        leaves = [means, scales, opacities, features, viewmats]
        if not exact:
            leaves = [leaf.float().to(DEVICE) for leaf in leaves]
        leaves = [leaf.detach().clone().requires_grad_() for leaf in leaves]
        if exact:
            seen = render(*leaves, Ks, *size, None, distortion, min_alpha=min_alpha, min_transmittance=0.0, median=True)
            assert seen.median_depth is not None
            outputs = (seen.features, seen.alpha, seen.depth * seen.alpha, seen.median_depth)
        else:
            raster = Raster(*size, min_alpha, 0.0)
            single = None if distortion is None else distortion.float().to(DEVICE)
            outputs = rasterize(*leaves, Ks.float().to(DEVICE), raster, single)[:4]
        loss = (torch.cat([outputs[0], *(o[..., None] for o in outputs[1:3])], -1) * weights.to(outputs[0])).sum()
        gradients = torch.autograd.grad(loss, leaves)
        results.append([[value.detach().double().cpu() for value in values] for values in (outputs, gradients)])
    return results


def assert_equal(results, pixels_off=0):
    """Compare; an alpha at the threshold may fall on either side of it in single precision, in a few pixels."""
    (outputs, gradients), (mine, my_gradients) = results
    for exact, single in zip(outputs, mine, strict=True):
        assert int(((exact - single).abs() > 5e-5 * exact.abs().clamp_min(1)).sum()) <= pixels_off
    for exact, single in zip(gradients, my_gradients, strict=True):
        assert (exact - single).norm() <= 1e-4 * exact.norm() + 1e-7


@pytest.mark.parametrize("min_alpha", [pytest.param(0.0, marks=pytest.mark.evidence), 1 / 255])
def test_values_and_gradients_equal_the_torch_renderer(min_alpha):
    assert_equal(both(scene(24), min_alpha))


@pytest.mark.evidence
@pytest.mark.parametrize("min_alpha", [0.0, 1 / 255])
def test_strong_distortion_equals_the_torch_renderer(min_alpha):
    """What lies far outside of a barrel's picture, the distortion would fold back into it."""
    size = (37, 20)  # six tiles, of which four are cut
    arguments, distortion = wide_scene(20, *size)
    assert_equal(both(arguments, min_alpha, size=size, distortion=distortion), pixels_off=2)


def test_four_coefficients_for_all_cameras():
    assert_equal(both(scene(12), distortion=torch.tensor(SKEWED[:4], dtype=torch.float64)))


def test_strong_distortion_equals_the_twin():
    (*leaves, Ks), distortion = wide_scene(24, *SIZE)
    results = []
    for exact in (True, False):
        tensors = [leaf if exact else leaf.float().to(DEVICE) for leaf in leaves]
        tensors = [tensor.detach().clone().requires_grad_() for tensor in tensors]
        if exact:
            image, alpha, _ = twin(*tensors, Ks, *SIZE, distortion=distortion)
        else:
            raster = Raster(*SIZE, 0.0, 0.0)
            image, alpha = rasterize(*tensors, Ks.float().to(DEVICE), raster, distortion.float().to(DEVICE))[:2]
        gradients = torch.autograd.grad(image.square().sum() + alpha.sum(), tensors)
        results.append([[v.detach().double().cpu() for v in values] for values in ((image, alpha), gradients)])
    assert_equal(results)


def test_no_distortion_is_a_pinhole():
    arguments = [value.float().to(DEVICE) for value in scene(24)]
    raster = Raster(*SIZE, 1 / 255, 0.0)
    plain, traced = (rasterize(*arguments, raster, none) for none in (None, torch.zeros(5, device=DEVICE)))
    for one, other in zip(plain[:4], traced[:4], strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    "coefficients", [*(pytest.param(lens, marks=pytest.mark.evidence) for lens in (BARREL, PINCUSHION)), SKEWED]
)
def test_distortion_loses_no_sphere(coefficients):
    """Small spheres on the rays of some pixels: these see them, and no others do."""
    width, height = 37, 20
    arguments, _ = wide_scene(1, width, height)
    K = arguments[-1][[0 if coefficients == BARREL else 1]]
    distortion = torch.tensor([coefficients], dtype=torch.float64)
    chosen = torch.arange(width * height)[::5]
    pixels = torch.stack([chosen % width, chosen // width], -1) + 0.5
    rays = pixel_rays(pixels.double(), K, distortion)[0]
    count = len(rays)
    single = (rays, torch.full((count,), 1e-4), torch.full((count,), 0.9), torch.ones(count, 1))
    tensors = [value.float().to(DEVICE) for value in (*single, torch.eye(4)[None], K)]
    raster = Raster(width, height, 1 / 255, 0.0)
    _, alpha, _, _, pairs = rasterize(*tensors, raster, distortion.float().to(DEVICE))
    expected = torch.zeros(width * height)
    expected[chosen] = 0.9
    torch.testing.assert_close(alpha.cpu().reshape(-1), expected, atol=1e-3, rtol=0)
    assert int(pairs) < 1.2 * count  # the bounds of the tiles are tight


@pytest.mark.evidence
def test_more_cameras_than_are_summed_together():
    assert_equal(both(scene(6, cameras=18), size=(7, 5)))


@pytest.mark.parametrize("channels", [pytest.param(1, marks=pytest.mark.evidence), 9])
def test_any_number_of_channels(channels):
    assert_equal(both(scene(12), channels=channels))


def test_bodies_that_stand_elsewhere_for_every_camera():
    means, *others = scene(10)
    shift = torch.tensor([[[0.0, 0, 0]], [[0.05, -0.02, 0.1]]], dtype=torch.float64)
    means = means + shift
    arguments = (means, *others)
    (outputs, _), (mine, _) = (both_per_camera(arguments, exact) for exact in (True, False))
    for exact, single in zip(outputs, mine, strict=True):
        torch.testing.assert_close(single, exact, atol=1e-4, rtol=1e-4)


def both_per_camera(arguments, exact):
    """Return features, alpha and the derivative by means (C, N, 3), from the torch renderer or the kernels."""
    tensors = [value if exact else value.float().to(DEVICE) for value in arguments]
    means = tensors[0].clone().requires_grad_()
    if exact:
        seen = render(means, *tensors[1:], *SIZE, min_transmittance=0.0)
        features, alpha = seen.features, seen.alpha
    else:
        features, alpha = rasterize(means, *tensors[1:], Raster(*SIZE, 1 / 255, 0.0))[:2]
    (gradient,) = torch.autograd.grad(features.square().sum() + alpha.sum(), means)
    return [value.detach().double().cpu() for value in (features, alpha, gradient)], None


def test_edges():
    """No spheres; one behind the camera; opacities 0 and 1; a sphere that the camera nearly touches; a far corner."""
    means, scales, opacities, features, viewmats, Ks = scene(8, cameras=1)
    raster = Raster(*SIZE, 1 / 255, 0.0)
    nothing = [value.float().to(DEVICE) for value in (means[:0], scales[:0], opacities[:0], features[:0], viewmats, Ks)]
    picture, alpha, *_ = rasterize(*nothing, raster)
    assert float(picture.abs().max()) == float(alpha.abs().max()) == 0
    means[0] = torch.tensor([0.0, 0, -9])
    means[1] = torch.tensor([0.0, 0, -0.9])
    means[2] = torch.tensor([5.0, 5, 0])
    opacities[3], opacities[4] = 0.0, 1.0
    assert_equal(both((means, scales, opacities, features, viewmats, Ks)))


def test_a_capacity_changes_nothing_while_it_suffices():
    arguments = [value.float().to(DEVICE) for value in scene(16)]
    counted = rasterize(*arguments, Raster(*SIZE, 1 / 255, 1e-4))
    roomy = rasterize(*arguments, Raster(*SIZE, 1 / 255, 1e-4, capacity=2 * int(counted[4])))
    for one, other in zip(counted, roomy, strict=True):
        torch.testing.assert_close(one, other, atol=0, rtol=0)


def test_a_capacity_too_small_loses_pairs_and_says_how_many_there_are():
    arguments = [value.float().to(DEVICE) for value in scene(16)]
    counted = rasterize(*arguments, Raster(*SIZE, 1 / 255, 1e-4))
    small = rasterize(*arguments, Raster(*SIZE, 1 / 255, 1e-4, capacity=int(counted[4]) // 2))
    assert int(small[4]) == int(counted[4])
    assert float((small[1] - counted[1]).abs().max()) > 0.01  # the farthest half of the pairs is not drawn
    assert float((small[1] - counted[1]).max()) < 1e-5


@pytest.mark.parametrize("lens", [None, SKEWED])
def test_more_tiles_than_keys_of_16_bits_can_number(lens):
    """Spheres of all sizes, one of them before every pixel: together as one by one."""
    means, scales, opacities, features, viewmats, Ks = [value.float().to(DEVICE) for value in scene(200, cameras=4)]
    scales = scales * torch.logspace(-1.5, 1.0, 200, device=DEVICE)
    width, height = 1920, 1200
    Ks = Ks * torch.tensor([width / 26, height / 19, 1.0], device=DEVICE)[:, None]
    distortion = None if lens is None else torch.tensor(lens, device=DEVICE)
    raster = Raster(width, height, 1 / 255, 0.0)
    assert len(Ks) * raster.columns * raster.rows > 2**15
    together = rasterize(means, scales, opacities, features, viewmats, Ks, raster, distortion)
    alone = [
        rasterize(means, scales, opacities, features, viewmats[[k]], Ks[[k]], raster, distortion) for k in range(4)
    ]
    assert int(together[4]) == sum(int(one[4]) for one in alone)
    for place in range(4):
        torch.testing.assert_close(together[place], torch.cat([one[place] for one in alone]), atol=0, rtol=0)


@pytest.mark.parametrize("value", [math.nan, pytest.param(math.inf, marks=pytest.mark.evidence)])
@pytest.mark.parametrize("lens", [pytest.param(None, marks=pytest.mark.evidence), BARREL])
def test_a_sphere_whose_place_is_not_finite_is_not_drawn(value, lens):
    means, *others = [tensor.float().to(DEVICE) for tensor in scene(12)]
    distortion = None if lens is None else torch.tensor(lens, device=DEVICE)
    raster = Raster(*SIZE, 1 / 255, 0.0)
    *spheres, viewmats, Ks = others
    without = rasterize(means[3:], *(v[3:] for v in spheres), viewmats, Ks, raster, distortion)
    means[0, 0] = means[1, 1] = means[2, 2] = value
    means.requires_grad_()
    output = rasterize(means, *others, raster, distortion)
    for one, other in zip(output, without, strict=True):
        torch.testing.assert_close(one.detach(), other, atol=1e-6, rtol=0)
    (gradient,) = torch.autograd.grad(output[0].sum(), means)
    assert torch.isfinite(gradient).all()


def test_a_pixel_under_many_spheres():
    count = 10_000
    means = torch.zeros(count, 3)
    means[:, 2] = torch.linspace(1, 2, count)
    features = torch.rand(count, 1, generator=torch.Generator().manual_seed(0))
    opacity = 100 / count / 2
    K = torch.tensor([[[10.0, 0, 0.5], [0, 10, 0.5], [0, 0, 1]]])
    spheres = (means, torch.full((count,), 0.1), torch.full((count,), opacity), features)
    tensors = [tensor.to(DEVICE) for tensor in (*spheres, torch.eye(4)[None], K)]
    picture, alpha, _, _, pairs = rasterize(*tensors, Raster(1, 1, opacity / 2, 0.0))
    weights = opacity * (1 - opacity) ** torch.arange(count, dtype=torch.float64)
    assert int(pairs) == count
    assert float(picture) == pytest.approx(float((weights * features[:, 0]).sum()), rel=1e-4)
    assert float(alpha) == pytest.approx(float(weights.sum()), rel=1e-4)


def test_order_motion_and_batch_do_not_matter():
    """Spheres in another order, spheres and cameras moved together, cameras one by one: the same pictures."""
    means, *rest, viewmats, Ks = scene(16, cameras=3)
    raster = Raster(*SIZE, 1 / 255, 0.0)

    def pictures(*tensors):
        return rasterize(*(tensor.float().to(DEVICE) for tensor in tensors), raster)[:4]

    reference = pictures(means, *rest, viewmats, Ks)
    p = torch.randperm(len(means), generator=torch.Generator().manual_seed(5))
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3], T[:3, 3] = rotation(), torch.tensor([0.1, -0.05, 0.07])
    moved = means @ T[:3, :3].T + T[:3, 3]
    loop = [pictures(means, *rest, viewmats[[k]], Ks[[k]]) for k in range(3)]
    others = [
        pictures(means[p], *(value[p] for value in rest), viewmats, Ks),
        pictures(moved, *rest, viewmats @ torch.linalg.inv(T), Ks),
        tuple(torch.cat(parts) for parts in zip(*loop, strict=True)),
    ]
    for other in others:
        for one, two in zip(reference, other, strict=True):
            assert int(((one - two).abs() > 1e-4).sum()) <= 2  # an alpha may cross the threshold, a depth the median


def test_gradients_equal_finite_differences():
    """The derivative along random directions, by central differences of the double-precision twin's picture."""
    *leaves, Ks = scene(6, cameras=1)
    weights = torch.randn(1, SIZE[1], SIZE[0], 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    single = [leaf.float().to(DEVICE).requires_grad_() for leaf in leaves]
    picture = rasterize(*single, Ks.float().to(DEVICE), Raster(*SIZE, 0.0, 0.0))[0]
    gradients = torch.autograd.grad((picture * weights.to(picture)).sum(), single)
    for place, gradient in enumerate(gradients):
        direction = torch.randn(
            leaves[place].shape, generator=torch.Generator().manual_seed(place), dtype=torch.float64
        )
        if place == 4:
            direction[:, 3] = 0  # a camera's last row is 0, 0, 0, 1
        sides = []
        for sign in (1e-5, -1e-5):
            values = list(leaves)
            values[place] = leaves[place] + sign * direction
            sides.append((twin(*values, Ks, *SIZE)[0] * weights).sum())
        numeric = float((sides[0] - sides[1]) / 2e-5)
        assert float((gradient.double().cpu() * direction).sum()) == pytest.approx(numeric, rel=2e-3, abs=1e-3)


def test_a_cuda_graph_captures_a_step():
    arguments = [value.float().to(DEVICE) for value in scene(300)]
    arguments[0].requires_grad_()

    def step():
        output = render(*arguments, 61, 47, capacity=20_000)
        return torch.autograd.grad(output.features.square().sum(), arguments[0])[0]

    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        expected = step()
        step()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        result = step()
    graph.replay()
    torch.cuda.synchronize()
    torch.testing.assert_close(result, expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("size", [(5_000, 4, 320, 240), (40_000, 1, 640, 480)])
def test_large_scenes_equal_the_torch_renderer(size):
    count, cameras, width, height = size
    means, _, opacities, features, viewmats, Ks = scene(count, cameras=cameras)
    Ks = Ks * torch.tensor([width / 26, height / 19, 1.0], dtype=torch.float64)[:, None]
    scales = torch.full((count,), 0.004, dtype=torch.float64)
    exact = render(means, scales, opacities, features, viewmats, Ks, width, height, min_transmittance=0.0)
    single = [value.float().to(DEVICE) for value in (means, scales, opacities, features, viewmats, Ks)]
    output = render(*single, width, height, min_transmittance=0.0)
    assert (output.features.double().cpu() - exact.features).norm() < 1e-3 * exact.features.norm()


def test_distorted_cameras_take_the_kernels_and_equal_the_torch_renderer():
    (*leaves, Ks), distortion = wide_scene(3000, 320, 240)
    leaves[1] = 0.3 * leaves[1]
    exact = render(*leaves, Ks, 320, 240, None, distortion, min_transmittance=0.0)
    single = [value.float().to(DEVICE) for value in (*leaves, Ks)]
    output = render(*single, 320, 240, None, distortion.float().to(DEVICE), min_transmittance=0.0)
    assert output.pairs is not None
    assert (output.features.double().cpu() - exact.features).norm() < 1e-3 * exact.features.norm()
    assert (output.alpha.double().cpu() - exact.alpha).norm() < 1e-3 * exact.alpha.norm()


@pytest.mark.parametrize("channels", [3, 9])
def test_features_may_differ_by_camera(channels):
    means, scales, opacities, _, viewmats, Ks = scene(24)
    features = torch.rand(len(Ks), len(means), channels, generator=torch.Generator().manual_seed(0)).double()
    exact = render(means, scales, opacities, features, viewmats, Ks, *SIZE, min_transmittance=0.0).features
    leaves = [value.float().to(DEVICE) for value in (means, scales, opacities, features, viewmats, Ks)]
    found = rasterize(*leaves, Raster(*SIZE, 1 / 255, 0.0))[0]
    torch.testing.assert_close(found.double().cpu(), exact, atol=5e-5, rtol=5e-5)
    with pytest.raises(ValueError, match="no derivative on CUDA"):
        rasterize(leaves[0].requires_grad_(), *leaves[1:], Raster(*SIZE, 1 / 255, 0.0))


def test_groups_are_seen_alone_on_a_gpu():
    arguments = scene(40)
    groups = [slice(0, 10), slice(25, 40)]
    exact = render(*arguments, 24, 17, groups=groups).alone
    found = render(*(value.float().cuda() for value in arguments), 24, 17, groups=groups).alone
    torch.testing.assert_close(found.double().cpu(), exact, atol=5e-5, rtol=5e-5)
