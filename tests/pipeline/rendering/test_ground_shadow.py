"""The shadow of a body on the ground: where the lamp's rays pass it, by its opacity there, and nowhere else."""

import numpy as np
import pytest
import torch
from cgwm.pipeline.rendering.ground_shadow import ShadedGround, shadow_of
from cgwm.pipeline.rendering.posed_scene import Labelled
from cgwm.schemas import Ground, GroundShadow, Light
from helpers.small_model import small_model

GROUND = Ground(offset_m=0.02)
TO_LAMP = np.array([0.6, 0.0, 0.8])
SHADOW = GroundShadow(to_lamp=(0.6, 0.0, 0.8), brightness_rgb=(0.5, 0.6, 0.7))
OPACITY, SCALE = 0.8, 0.03


def spheres(means: np.ndarray, scale: float, opacity: float, label: int) -> Labelled:
    count = means.shape[-2]
    return Labelled(
        means=torch.as_tensor(means, dtype=torch.float32),
        scales=torch.full((count,), scale),
        opacities=torch.full((count,), opacity),
        colors=torch.rand(*means.shape[:-1], 3),
        labels=torch.full((count,), label, dtype=torch.int64),
    )


def test_a_sphere_takes_its_opacity_from_the_rays_that_pass_it() -> None:
    """1 - a exp(-d^2 / 2 s^2), d the distance of the centre from the ray to the lamp, in two frames."""
    rng = np.random.default_rng(0)
    places = np.c_[rng.uniform(-0.3, 0.3, (200, 2)), np.full(200, 0.02)]
    centers = np.array([[0.05, -0.02, 0.15], [0.11, 0.04, 0.3]])
    shaded = ShadedGround(SHADOW, GROUND, spheres(places, 1e-4, 0.9, 0))
    dimming = shaded.dimming([(0, spheres(centers[:, None], SCALE, OPACITY, 1))])
    off = centers[:, None] - places
    distance = np.linalg.norm(np.cross(off, TO_LAMP), axis=-1)
    cover = OPACITY * np.exp(-(distance**2) / (2 * SCALE**2))
    cover[cover < 1 / 255] = 0
    expected = 1 - cover[..., None] * (1 - np.array(SHADOW.brightness_rgb))
    assert len(shaded.rows) == 200 and cover.max() > 0.7
    np.testing.assert_allclose(dimming.numpy(), expected, atol=4e-3)  # the lamp sees it in 96 pixels a side


def test_bodies_shade_together_and_only_spheres_of_the_ground() -> None:
    places = np.array([[0.0, 0.0, 0.02], [0.0, 0.0, 0.2], [0.3, 0.3, 0.02]])
    still = Labelled.joined([spheres(places, 1e-3, 0.9, 0), spheres(places[:1], 1e-3, 0.9, 1)])
    shaded = ShadedGround(SHADOW, GROUND, still)
    assert shaded.rows.tolist() == [0, 2]  # not what is high, nor a body
    above = places[:1] + 0.3 * TO_LAMP
    one, two = (shaded.dimming([(b, spheres(above[None], SCALE, OPACITY, b + 1)) for b in range(n)]) for n in (1, 2))
    red = 1 - 0.5 * OPACITY
    assert one[0, 0, 0] == pytest.approx(red, abs=4e-3) and (one[0, 1] == 1).all()
    assert two[0, 0, 0] == pytest.approx(1 - 0.5 * (1 - (1 - OPACITY) ** 2), abs=4e-3)
    assert ShadedGround.visible(one[0]).tolist() == [True, False]
    colors = shaded.shaded(still, one[0]).colors
    assert torch.equal(colors[1:], still.colors[1:]) and (colors[0] < still.colors[0]).all()


def test_the_lamp_comes_from_photos_else_from_the_light_of_the_videos() -> None:
    file = small_model().file
    assert shadow_of(file) is None
    lit = file.model_copy(update={"light": Light(lamp=(0.0, 0.3, 0.4), sky=0.25)})
    found = shadow_of(lit)
    assert found is not None and found.to_lamp == pytest.approx((0, 0.6, 0.8))
    assert found.brightness_rgb == pytest.approx([1.25 / 1.65] * 3)
    assert shadow_of(lit.model_copy(update={"ground_shadow": SHADOW})) == SHADOW
    assert shadow_of(lit.model_copy(update={"light": Light(lamp=(0.0, 0.3, -0.4), sky=0.25)})) is None
    assert shadow_of(lit.model_copy(update={"ground": None})) is None
