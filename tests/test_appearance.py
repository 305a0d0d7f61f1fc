"""Light on a body that turns, and how a motion tells it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cgwm.pipeline.appearance import fit_light
from cgwm.pipeline.physics.rotation import quat_to_matrix
from cgwm.pipeline.splats.relighting import Relighting, brightness, light_basis
from cgwm.schemas import Light
from small_model import small_model

LIGHT = Light(coefficients=(0.2, -0.1, 0.3, 0.05, 0.0, -0.05, 0.1, 0.08))


def _directions(count: int, seed: int) -> np.ndarray:
    directions = np.random.default_rng(seed).standard_normal((count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_basis_is_orthogonal_over_the_sphere() -> None:
    basis = light_basis(torch.as_tensor(_directions(20000, 2)))
    gram = (basis.T @ basis / len(basis)).numpy()
    off = gram - np.diag(np.diag(gram))
    assert np.abs(off).max() < 0.01
    assert float(basis.mean(0).abs().max()) < 0.01  # so that 1 is the mean brightness


def test_light_is_found_from_brightness_ratios_with_outliers() -> None:
    rng = np.random.default_rng(3)
    photo, now = _directions(3000, 4), _directions(3000, 5)
    ratio = (brightness(LIGHT, torch.as_tensor(now)) / brightness(LIGHT, torch.as_tensor(photo))).numpy()
    ratio *= 1 + 0.05 * rng.standard_normal(3000)
    ratio[:300] *= 0.5  # a cast shadow
    found = fit_light(ratio, now, photo, 3000)
    assert found.coefficients == pytest.approx(LIGHT.coefficients, abs=0.02)


def test_what_the_motion_does_not_tell_stays_dark() -> None:
    """A body that did not turn says nothing: every ratio is 1, and so is the light."""
    photo = _directions(500, 6)
    assert fit_light(np.ones(500), photo, photo, 500).coefficients == pytest.approx((0.0,) * 8, abs=1e-9)


def test_photos_pose_keeps_its_colours_and_a_turn_does_not() -> None:
    body = small_model().file.bodies[0]
    normals = torch.as_tensor(_directions(200, 7))
    relighting = Relighting.of(LIGHT, body, normals)
    upright = torch.tensor(body.photo_pose.quat_wxyz, dtype=torch.float64)
    torch.testing.assert_close(relighting.factors(upright), torch.ones(200, dtype=torch.float64))
    over = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64)
    expected = brightness(LIGHT, normals @ quat_to_matrix(over).T) / relighting.in_photos
    torch.testing.assert_close(relighting.factors(over), expected)
    assert float(relighting.factors(over).std()) > 0.1
