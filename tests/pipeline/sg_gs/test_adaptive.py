"""Spheres that multiply and move: the laws of splitting, the budget, colours that depend on the direction."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.cameras import Camera
from cgwm.datasets.shapes.ply import Splats, read_splats, write_splats
from cgwm.pipeline.geometry.spheres import Spheres
from cgwm.pipeline.geometry.spherical_harmonics import harmonics
from cgwm.pipeline.rendering.image_metrics import psnr
from cgwm.pipeline.rendering.label_renderer import LabelRenderer
from cgwm.pipeline.sg_gs.appearance import mcmc
from cgwm.pipeline.sg_gs.appearance.losses import scene_loss
from cgwm.pipeline.sg_gs.appearance.mcmc import DEAD, Population, fit_adaptively, shared_among
from cgwm.pipeline.sg_gs.appearance.optimize import Rates, Trainable, descend
from cgwm.pipeline.sg_gs.photos.photo_exposure import Exposures
from cgwm.pipeline.sg_gs.photos.views import View, render_view
from cgwm.schemas import NotConvergedError
from helpers.small_model import small_model


def test_copies_show_what_one_sphere_showed():
    opacity = torch.tensor([0.02, 0.3, 0.9, 0.99, 0.6], dtype=torch.float64)
    scale = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5], dtype=torch.float64)
    copies = torch.tensor([2, 3, 2, 7, 51])
    new, smaller = shared_among(opacity, scale, copies)
    x = torch.linspace(-10, 10, 200_001, dtype=torch.float64)
    for k in range(len(copies)):
        one = opacity[k] * torch.exp(-((x / scale[k]) ** 2) / 2)
        together = 1 - (1 - new[k] * torch.exp(-((x / smaller[k]) ** 2) / 2)) ** copies[k]
        assert float(together.max()) == pytest.approx(float(opacity[k]), rel=1e-6)
        assert float(together.sum()) == pytest.approx(float(one.sum()), rel=1e-6)


def test_harmonics_are_orthonormal_over_the_sphere():
    directions = torch.randn(400_000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    basis = harmonics(torch.nn.functional.normalize(directions, dim=-1), 3)
    gram = 4 * math.pi * basis.T @ basis / len(basis)
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), atol=0.02, rtol=0)


def _spheres(count=300, seed=0):
    generator = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=generator) - 0.5
    colors = 0.5 + 0.5 * torch.sin(9 * means)
    return Spheres(means, torch.full((count,), 0.05), torch.full((count,), 0.8), colors)


def _view(spheres, angle, higher=None):
    K = np.array([[60.0, 0, 24], [0, 60, 20], [0, 0, 1]])
    T = np.eye(4)
    c, s = math.cos(angle), math.sin(angle)
    T[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    T[:3, 3] = T[:3, :3] @ [0, 0, -1.6]
    camera = Camera(width=48, height=40, K=K, distortion=np.zeros(0), T_world_cam=T)
    tensors = [torch.as_tensor(a, dtype=torch.float32) for a in (K, camera.T_cam_world)]
    blank = View(str(angle), torch.zeros(40, 48, 3), None, *tensors, camera, None, torch.zeros(1, 1))
    seen = Spheres(
        means=spheres.means, scales=spheres.scales, opacities=spheres.opacities, colors=spheres.colors, harmonics=higher
    )
    with torch.no_grad():
        picture = render_view(seen, blank).features[0]
    return View(blank.name, picture, None, *tensors, camera, None, blank.grey)


def adapted(iterations):
    """Return few spheres, those of a fit that lets them multiply, the photos, and the history of the fit."""
    truth = _spheres()
    views = [_view(truth, angle) for angle in np.linspace(0, 5.5, 8)]
    few = Spheres(*(getattr(_spheres(60, 5), key) for key in ("means", "scales", "opacities", "colors")))
    settings = {"budget": 90, "degree": 1, "iterations": iterations, "spread": 1.6, "seed": 0, "what": "test"}
    exposures = Exposures(views, False)
    fitted, history = fit_adaptively(few, views, scene_loss(None, exposures), exposures=exposures, **settings)
    return few, fitted, views, history


def ratios_db(few, fitted, views):
    """Return the mean signal-to-noise ratios of renders before and after a fit [dB]."""
    return [
        np.mean([psnr(render_view(one, view).features[0].detach(), view.image) for view in views])
        for one in (few, fitted)
    ]


# In the suite: the next test: it improves.
@pytest.mark.evidence
def test_a_fit_improves_by_several_decibels():
    few, fitted, views, _ = adapted(200)
    before, after = ratios_db(few, fitted, views)
    assert after > before + 5


def test_a_fit_keeps_to_its_budget_improves_and_repeats(monkeypatch):
    monkeypatch.setattr(mcmc, "REFINED_EVERY", 10)
    few, fitted, views, history = adapted(30)
    assert len(few) < len(fitted) <= 90
    assert history[-1].spheres == len(fitted)
    assert torch.isfinite(fitted.means).all()
    before, after = ratios_db(few, fitted, views)
    assert after > before + 0.3
    assert torch.equal(fitted.means, adapted(30)[1].means)


def test_dead_spheres_move_to_living_ones():
    spheres = _spheres(50)
    spheres.opacities[:20] = DEAD / 2
    population = Population(spheres, 0, 1.0)
    population.refine(50, torch.Generator().manual_seed(0))
    now = population.spheres()
    assert len(population) == 50
    assert float(now.opacities.detach().min()) >= DEAD
    assert torch.isin(now.means.detach()[:20, 0], spheres.means[20:, 0]).all()


def test_colours_that_depend_on_the_direction_survive_the_file_and_reach_the_labels(tmp_path):
    generator = torch.Generator().manual_seed(3)
    spheres = _spheres(80)
    higher = 0.15 * torch.randn(80, 8, 3, generator=generator)
    splats = Spheres(
        means=spheres.means, scales=spheres.scales, opacities=spheres.opacities, colors=spheres.colors, harmonics=higher
    ).to_numpy()
    write_splats(tmp_path / "scene.ply", splats, "world", sh_degree=3)
    back = read_splats(tmp_path / "scene.ply", harmonics=True)
    assert back.harmonics is not None
    np.testing.assert_allclose(back.harmonics[:, :8], splats.harmonics, atol=1e-6)
    assert not back.harmonics[:, 8:].any()
    assert read_splats(tmp_path / "scene.ply").harmonics is None
    views = [_view(spheres, angle, higher) for angle in (0.0, 2.0)]
    assert float((views[0].image - _view(spheres, 0.0).image).abs().mean()) > 0.01
    model = small_model()
    scene = Splats(back.means, back.scales, back.opacities, back.colors, harmonics=back.harmonics)
    seen = type(model)(root=model.root, file=model.file, scene=scene, fit=model.fit)
    renderer = LabelRenderer(seen, {"a": views[1].camera})
    block = next(iter(renderer.blocks(np.zeros((1, 2, 3)), np.tile([1.0, 0, 0, 0], (1, 2, 1)))))
    difference = np.abs(block.image[0] / 255 - views[1].image.clamp(0, 1).numpy())
    assert difference.mean() < 0.01


@pytest.mark.parametrize("bad", ["loss", "gradient"])
def test_a_fit_that_diverges_ends_at_its_step(bad):
    truth = _spheres()
    views = [_view(truth, 0.0)]
    steps = iter(range(100))

    def loss(spheres, view, generator):
        value, wrong = scene_loss(None, Exposures(views, False))(spheres, view, generator)
        if next(steps) < 4:
            return value, wrong
        # the square root of 0 has a finite value, and no finite derivative
        value = value * math.nan if bad == "loss" else value + (0 * spheres.means).square().sum().sqrt()
        return value, wrong

    trainable = Trainable(truth, Rates(means=0.01, log_scales=0.01, logits=0.01, colors=0.01))
    with pytest.raises(NotConvergedError, match=r"'background' diverged by step \d+ of 6") as caught:
        descend(trainable, views, loss, 6, 0, "background", 0.002)
    step = int(str(caught.value).split("step ")[1].split(" of")[0])
    assert step == (5 if bad == "loss" else 6)


def test_an_adaptive_fit_that_diverges_ends_at_its_step():
    truth = _spheres()
    view = _view(truth, 0.0)

    def loss(spheres, view, generator):
        value, wrong = scene_loss(None, exposures)(spheres, view, generator)
        return value * math.inf, wrong

    exposures = Exposures([view], False)
    options = {"budget": 400, "degree": 0, "iterations": 3, "spread": 1.0, "seed": 0, "what": "background"}
    with pytest.raises(NotConvergedError, match="'background' diverged by step 1 of 3"):
        fit_adaptively(truth, [view], loss, exposures=exposures, **options)
