"""The renderer against a slow twin, and against the laws that it must obey."""

import math

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.cameras import distort
from cgwm.pipeline.rendering import composite_reference, raster_host
from cgwm.pipeline.rendering.render import render

EXACT = {"min_alpha": 0.0, "min_transmittance": 0.0}


BARREL, PINCUSHION, SKEWED = [-0.25, 0.0, 0.0, 0.0, 0.0], [0.3, 0.1, 0.0, 0.0, 0.02], [-0.1, 0.05, 0.04, -0.06, 0.0]


def twin(means, scales, opacities, features, viewmats, Ks, width, height, background=None, distortion=None):
    """Render by one loop over all spheres for all pixels, without tiles, thresholds or hand-written derivatives."""
    images, alphas, depths = [], [], []
    u, v = torch.meshgrid(
        torch.arange(width, dtype=means.dtype) + 0.5, torch.arange(height, dtype=means.dtype) + 0.5, indexing="xy"
    )
    for camera, (view, K) in enumerate(zip(viewmats, Ks, strict=True)):
        local = means @ view[:3, :3].T + view[:3, 3]
        rays = torch.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], torch.ones_like(u)], -1).to(means)
        if distortion is not None:
            rays[..., :2] = undistorted(rays[..., :2], distortion[camera].tolist())
        rays = rays / rays.norm(dim=-1, keepdim=True)
        left = torch.ones(height, width, dtype=means.dtype)
        image = torch.zeros(height, width, features.shape[1], dtype=means.dtype)
        depth = torch.zeros(height, width, dtype=means.dtype)
        for index in torch.argsort(local.norm(dim=1)):
            centre, scale = local[index], scales[index]
            if centre[2] <= scale:
                continue
            dist2 = torch.linalg.cross(centre.expand_as(rays), rays).square().sum(-1)
            alpha = (opacities[index] * torch.exp(-dist2 / (2 * scale**2))).clamp_max(0.99)
            image = image + (left * alpha)[..., None] * features[index]
            depth = depth + left * alpha * centre[2]
            left = left * (1 - alpha)
        if background is not None:
            image = image + left[..., None] * background
        images.append(image)
        alphas.append(1 - left)
        depths.append(depth / (1 - left))
    return torch.stack(images), torch.stack(alphas), torch.stack(depths)


def undistorted(points, coefficients):
    """Undo OpenCV's distortion by walking to it in small steps, from none to all of it (Davidenko's method)."""
    steps, start = 50, points.reshape(-1, 2).double().numpy()
    found = start.copy()
    for step in [*range(steps), *[steps] * 6]:
        partial = step / steps * np.asarray(coefficients)
        jacobian = np.stack(
            [(distort(found + h, partial) - distort(found - h, partial)) / 2e-6 for h in 1e-6 * np.eye(2)], -1
        )
        found -= np.linalg.solve(jacobian, (distort(found, partial) - start)[..., None])[..., 0]
    return torch.from_numpy(found).to(points).reshape(points.shape)


def wide_scene(count=40, width=25, height=19):
    """Spheres all around two cameras that see as much as their strong distortions allow."""
    means, scales, opacities, features, viewmats, Ks = scene(count)
    means = 4 * means
    Ks = torch.zeros_like(Ks)
    Ks[:, 2, 2] = 1
    for K, reach in zip(Ks, (0.72, 1.3), strict=True):
        K[0, 0] = K[1, 1] = math.hypot(width, height) / 2 / reach
        K[0, 2], K[1, 2] = width / 2 + 0.3, height / 2 - 0.2
    return [means, scales, opacities, features, viewmats, Ks], torch.tensor([BARREL, PINCUSHION], dtype=torch.float64)


def scene(count=40, dtype=torch.float64, seed=0, cameras=2):
    generator = torch.Generator().manual_seed(seed)
    means = 0.15 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    scales = 0.02 + 0.05 * torch.rand(count, generator=generator, dtype=torch.float64)
    opacities = 0.1 + 0.85 * torch.rand(count, generator=generator, dtype=torch.float64)
    features = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    viewmats = torch.stack([look_at(angle) for angle in torch.linspace(0, 2, cameras).tolist()])
    K = torch.tensor([[30.0, 0, 13.0], [0, 32.0, 9.5], [0, 0, 1]], dtype=torch.float64)
    Ks = torch.stack([K] * cameras)
    Ks[-1, 0, 2] += 1.5
    return [value.to(dtype) for value in (means, scales, opacities, features, viewmats, Ks)]


def look_at(angle):
    """A camera (T_cam_world) one metre from the origin, turned about y."""
    view = torch.eye(4, dtype=torch.float64)
    view[0, 0] = view[2, 2] = math.cos(angle)
    view[0, 2], view[2, 0] = math.sin(angle), -math.sin(angle)
    view[2, 3] = 1.0
    return view


def rotation(seed=1):
    matrix, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))
    return matrix * torch.linalg.det(matrix).sign()


@pytest.mark.parametrize("compiled", [True, False])
def test_values_equal_the_twin(compiled, monkeypatch):
    if not compiled:
        monkeypatch.setattr(raster_host, "supported", lambda _: False)
    arguments = scene()
    background = torch.tensor([0.2, 0.5, 0.8], dtype=torch.float64)
    output = render(*arguments, 25, 19, background, **EXACT)
    image, alpha, depth = twin(*arguments, 25, 19, background)
    torch.testing.assert_close(output.features, image, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(output.alpha, alpha, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(output.depth, depth, atol=1e-9, rtol=1e-9)


def test_thresholds_change_little():
    arguments = scene()
    output = render(*arguments, 25, 19)
    image, _, _ = twin(*arguments, 25, 19)
    # Each of the spheres over a pixel may lose up to 1/255 of its colour, seen through what is before it.
    assert (output.features - image).abs().max() < 4 / 255


def test_single_precision_equals_double():
    output = render(*scene(dtype=torch.float32), 25, 19, **EXACT)
    image, _, _ = twin(*scene(), 25, 19)
    torch.testing.assert_close(output.features.double(), image, atol=2e-5, rtol=0)


def test_gradients_equal_the_twin():
    weights = torch.rand(2, 19, 25, 5, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    gradients = []
    for function in (lambda *a: render(*a, 25, 19, **EXACT), lambda *a: twin(*a, 25, 19)):
        *leaves, Ks = scene()
        for leaf in leaves:
            leaf.requires_grad_()
        output = function(*leaves, Ks)
        image, alpha, depth = output if isinstance(output, tuple) else (output.features, output.alpha, output.depth)
        loss = (torch.cat([image, alpha[..., None], depth[..., None]], -1) * weights).sum()
        gradients.append(torch.autograd.grad(loss, leaves))
    for mine, other in zip(*gradients, strict=True):
        torch.testing.assert_close(mine, other, atol=1e-8, rtol=1e-7)


@pytest.mark.parametrize("coefficients", [BARREL, PINCUSHION, SKEWED])
def test_distorted_rays_are_those_that_the_distortion_sends_there(coefficients):
    from cgwm.pipeline.rendering.rays import pixel_rays

    _, _, _, _, _, Ks = wide_scene(1)[0]
    K = Ks[0 if coefficients == BARREL else 1]
    u, v = torch.meshgrid(torch.arange(25.0) + 0.5, torch.arange(19.0) + 0.5, indexing="xy")
    pixels = torch.stack([u, v], -1).double().reshape(-1, 2)
    rays = pixel_rays(pixels, K[None], torch.tensor([coefficients], dtype=torch.float64))[0]
    back = torch.from_numpy(distort((rays[:, :2] / rays[:, 2:]).numpy(), np.array(coefficients)))
    torch.testing.assert_close(back @ K[:2, :2].T + K[:2, 2], pixels, atol=1e-9, rtol=0)
    expected = undistorted((pixels - K[:2, 2]) @ torch.linalg.inv(K[:2, :2]).T, coefficients)
    torch.testing.assert_close(rays[:, :2] / rays[:, 2:], expected, atol=1e-8, rtol=0)  # and no other root


def test_strong_distortion_equals_the_twin():
    (*leaves, Ks), distortion = wide_scene()
    weights = torch.rand(2, 19, 25, 5, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    gradients, images = [], []
    for function in (
        lambda *a: render(*a, 25, 19, distortion=distortion, **EXACT),
        lambda *a: twin(*a, 25, 19, distortion=distortion),
    ):
        leaves = [leaf.detach().clone().requires_grad_() for leaf in leaves]
        output = function(*leaves, Ks)
        image, alpha, depth = output if isinstance(output, tuple) else (output.features, output.alpha, output.depth)
        images.append(torch.cat([image, alpha[..., None], depth[..., None]], -1))
        gradients.append(torch.autograd.grad((images[-1] * weights).sum(), leaves))
    torch.testing.assert_close(*images, atol=1e-7, rtol=1e-7)
    for mine, other in zip(*gradients, strict=True):
        torch.testing.assert_close(mine, other, atol=1e-6, rtol=1e-6)


def test_culling_loses_nothing_under_strong_distortion():
    arguments, distortion = wide_scene(200, 61, 47)
    least = 1e-3
    culled = render(*arguments, 61, 47, distortion=distortion, min_alpha=least, min_transmittance=0.0, tile_size=8)
    whole = render(*arguments, 61, 47, distortion=distortion, min_alpha=least, min_transmittance=0.0, tile_size=64)
    torch.testing.assert_close(culled.features, whole.features, atol=1e-9, rtol=0)


def test_gradients_equal_finite_differences():
    *leaves, Ks = scene(count=5, cameras=1)
    for leaf in leaves:
        leaf.requires_grad_()

    def image(*values):
        output = render(*values, Ks, 9, 7, **EXACT)
        return output.features, output.alpha

    torch.autograd.gradcheck(image, leaves, atol=1e-6)


def test_alpha_lies_in_the_unit_interval():
    means, scales, _, features, viewmats, Ks = scene()
    output = render(means, 4 * scales, torch.ones_like(scales), features, viewmats, Ks, 25, 19)
    assert output.alpha.min() >= 0
    assert output.alpha.max() <= 1


def test_a_sphere_of_opacity_1_hides_what_is_behind_up_to_a_hundredth():
    means = torch.tensor([[0.0, 0, 1], [0, 0, 2]], dtype=torch.float64)
    K = torch.tensor([[[10.0, 0, 0.5], [0, 10, 0.5], [0, 0, 1]]], dtype=torch.float64)
    view, scales = torch.eye(4, dtype=torch.float64)[None], torch.full((2,), 0.1, dtype=torch.float64)
    colors, ones = torch.eye(2, dtype=torch.float64), torch.ones(2, dtype=torch.float64)
    output = render(means, scales, ones, colors, view, K, 1, 1, median=True, **EXACT)
    expected = torch.tensor([0.99, 0.01 * 0.99], dtype=torch.float64)
    torch.testing.assert_close(output.features[0, 0, 0], expected)
    torch.testing.assert_close(output.depth[0, 0, 0], (expected * means[:, 2]).sum() / expected.sum())
    assert float(output.median_depth) == 1


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("min_alpha", [0.0, 1 / 255])
def test_a_sphere_whose_place_is_not_finite_is_not_drawn(value, min_alpha):
    means, *others = scene()
    for axis in range(3):
        spoilt = means.clone()
        spoilt[[4, 11], axis] = value
        kept = torch.ones(len(means), dtype=torch.bool)
        kept[[4, 11]] = False
        spoilt.requires_grad_()
        output = render(spoilt, *others, 25, 19, min_alpha=min_alpha)
        *spheres, viewmats, Ks = others
        without = render(means[kept], *(v[kept] for v in spheres), viewmats, Ks, 25, 19, min_alpha=min_alpha)
        torch.testing.assert_close(output.features, without.features, atol=1e-12, rtol=0)
        (gradient,) = torch.autograd.grad(output.features.sum(), spoilt)
        assert torch.isfinite(gradient[kept]).all()


def test_many_spheres_over_one_pixel():
    count = 10_000
    means = torch.zeros(count, 3, dtype=torch.float64)
    means[:, 2] = torch.linspace(1, 2, count, dtype=torch.float64)
    features = torch.rand(count, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    opacities = torch.full((count,), 0.01, dtype=torch.float64)
    K = torch.tensor([[[10.0, 0, 0.5], [0, 10, 0.5], [0, 0, 1]]], dtype=torch.float64)
    scales = torch.ones(count, dtype=torch.float64) * 0.1
    view = torch.eye(4, dtype=torch.float64)[None]
    output = render(means, scales, opacities, features, view, K, 1, 1, min_transmittance=0.0)
    expected = (0.01 * 0.99 ** torch.arange(count, dtype=torch.float64) * features[:, 0]).sum()
    torch.testing.assert_close(output.features[0, 0, 0, 0], expected)


@pytest.mark.parametrize(("least", "evaluated"), [(1e-4, 64), (0.0, 160)])
def test_what_lies_behind_an_opaque_pixel_is_not_evaluated(monkeypatch, least, evaluated):
    """Of opacity 0.25, 33 spheres in a row leave less than 1e-4; what comes after that chunk of 32 is left out."""
    monkeypatch.setattr(raster_host, "supported", lambda _: False)
    seen = []
    evaluate = composite_reference._evaluate
    monkeypatch.setattr(composite_reference, "_evaluate", lambda *all: seen.append(all[3].shape[1]) or evaluate(*all))
    means = torch.zeros(160, 3, dtype=torch.float64)
    means[:, 2] = torch.linspace(1, 2, 160, dtype=torch.float64)
    opacities = torch.full((160,), 0.25, dtype=torch.float64)
    features, scales = torch.ones(160, 1, dtype=torch.float64), torch.full((160,), 0.1, dtype=torch.float64)
    K = torch.tensor([[[10.0, 0, 0.5], [0, 10, 0.5], [0, 0, 1]]], dtype=torch.float64)
    view = torch.eye(4, dtype=torch.float64)[None]
    output = render(means, scales, opacities, features, view, K, 1, 1, min_transmittance=least)
    assert sum(seen) == evaluated
    assert float(output.alpha) == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("tile_size", [4, 16])
def test_tiles_do_not_show(tile_size):
    arguments = scene(count=200, seed=4)
    reference = render(*arguments, 61, 47, min_transmittance=0.0)
    other = render(*arguments, 61, 47, min_transmittance=0.0, tile_size=tile_size)
    torch.testing.assert_close(reference.features, other.features, atol=1e-12, rtol=0)
    early = render(*arguments, 61, 47, tile_size=tile_size)
    torch.testing.assert_close(reference.features, early.features, atol=1e-4, rtol=0)


def test_order_of_spheres_does_not_matter():
    means, scales, opacities, features, viewmats, Ks = scene()
    p = torch.randperm(means.shape[0], generator=torch.Generator().manual_seed(5))
    reference = render(means, scales, opacities, features, viewmats, Ks, 25, 19)
    permuted = render(means[p], scales[p], opacities[p], features[p], viewmats, Ks, 25, 19)
    torch.testing.assert_close(reference.features, permuted.features, atol=1e-12, rtol=0)


def test_moving_the_body_is_moving_the_camera_back():
    means, scales, opacities, features, viewmats, Ks = scene()
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3], T[:3, 3] = rotation(), torch.tensor([0.1, -0.05, 0.07])
    moved = render(means @ T[:3, :3].T + T[:3, 3], scales, opacities, features, viewmats, Ks, 25, 19)
    camera = render(means, scales, opacities, features, viewmats @ T, Ks, 25, 19)
    torch.testing.assert_close(moved.features, camera.features, atol=1e-10, rtol=0)


def test_a_batch_is_a_loop():
    means, scales, opacities, features, viewmats, Ks = scene(cameras=3)
    together = render(means, scales, opacities, features, viewmats, Ks, 25, 19)
    for index in range(3):
        alone = render(means, scales, opacities, features, viewmats[[index]], Ks[[index]], 25, 19)
        torch.testing.assert_close(together.features[index], alone.features[0], atol=1e-12, rtol=0)
    per_camera = render(means.expand(3, -1, -1), scales, opacities, features, viewmats, Ks, 25, 19)
    torch.testing.assert_close(together.features, per_camera.features)


def test_a_crop_is_a_shifted_camera():
    means, scales, opacities, features, viewmats, Ks = scene()
    whole = render(means, scales, opacities, features, viewmats, Ks, 25, 19, min_transmittance=0.0)
    shifted = Ks.clone()
    shifted[:, :2, 2] -= torch.tensor([6.0, 3.0], dtype=torch.float64)
    crop = render(means, scales, opacities, features, viewmats, shifted, 11, 9, min_transmittance=0.0)
    torch.testing.assert_close(whole.features[:, 3:12, 6:17], crop.features, atol=1e-9, rtol=0)


def test_distorted_rays_project_where_opencv_says():
    cv2 = pytest.importorskip("cv2")
    from cgwm.pipeline.rendering.rays import pixel_rays

    K = torch.tensor([[[300.0, 0, 161], [0, 310, 118], [0, 0, 1]]], dtype=torch.float64)
    distortion = torch.tensor([[-0.2, 0.05, 0.001, -0.002]], dtype=torch.float64)
    pixels = torch.tensor([[0.5, 0.5], [161, 118], [310, 20], [40.0, 230.0]], dtype=torch.float64)
    rays = pixel_rays(pixels, K, distortion)[0]
    back, _ = cv2.projectPoints(rays.numpy(), (0, 0, 0), (0, 0, 0), K[0].numpy(), distortion[0].numpy())
    torch.testing.assert_close(torch.from_numpy(back[:, 0]), pixels, atol=1e-6, rtol=0)


def test_nothing_to_see():
    means, scales, opacities, features, viewmats, Ks = scene()
    background = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    one = render(
        means[:1] - viewmats.new_tensor([0, 0, 9.0]),
        scales[:1],
        opacities[:1],
        features[:1],
        viewmats[:1],
        Ks[:1],
        25,
        19,
        background,
    )
    assert torch.equal(one.features, background.expand(1, 19, 25, 3))
    empty = render(means[:0], scales[:0], opacities[:0], features[:0], viewmats, Ks, 25, 19, background)
    assert torch.equal(empty.features, background.expand(2, 19, 25, 3))
    behind = render(means + viewmats.new_tensor([0, 0, -9.0]), scales, opacities, features, viewmats[:1], Ks[:1], 9, 9)
    assert behind.alpha.max() == 0
    clear = render(means, scales, 0 * opacities, features, viewmats, Ks, 25, 19)
    assert clear.alpha.max() == 0
    assert torch.isfinite(clear.depth).all()


def test_groups_are_seen_alone():
    """The opacity of some spheres alone is that of a picture of these alone, whatever hides them."""
    means, scales, opacities, features, viewmats, Ks = scene(40)
    groups = [slice(0, 10), slice(25, 40)]
    seen = render(means, scales, opacities, features, viewmats, Ks, 24, 17, groups=groups)
    assert seen.alone is not None and seen.alone.shape == (2, 17, 24, 2)
    for number, group in enumerate(groups):
        alone = render(means[group], scales[group], opacities[group], features[group], viewmats, Ks, 24, 17)
        torch.testing.assert_close(seen.alone[..., number], alone.alpha)
        assert float(alone.alpha.max()) > 0.5
        short = render(means, scales, opacities, features, viewmats, Ks, 24, 17, groups=groups, group_transmittance=0.4)
        assert short.alone is not None and seen.alone is not None
        assert ((short.alone > 0.6) == (seen.alone > 0.6)).all() and (short.alone <= seen.alone + 1e-12).all()


def test_features_may_differ_by_camera():
    means, scales, opacities, features, viewmats, Ks = scene(40, cameras=3)
    each = torch.stack([features, features.flip(0), 2 * features])
    seen = render(means, scales, opacities, each, viewmats, Ks, 24, 17)
    for camera in range(3):
        one = slice(camera, camera + 1)
        alone = render(means, scales, opacities, each[camera], viewmats[one], Ks[one], 24, 17)
        torch.testing.assert_close(seen.features[one], alone.features)
