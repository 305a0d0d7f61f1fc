"""Information that shrinks by what the model misses: the closed form of a Gaussian, and its two limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from cgwm.pipeline.phys_geo.tracks.multiple_shooting import ShootingFit, ShootingPrior
from cgwm.pipeline.phys_geo.tracks.tempered_posterior import (
    FRICTION_LAW_MISFIT,
    FRICTION_LAW_STD,
    tempered,
    with_friction_law_error,
)
from cgwm.pipeline.physics.parameters import CONTACT_TIME, FRICTION
from cgwm.pipeline.physics.state import State

F64 = torch.float64
EXCESS = 20.0
PRIOR = ShootingPrior(
    torch.tensor([0.0, 1.0], dtype=F64),
    torch.tensor([0.5, 0.6], dtype=F64),
    torch.tensor([[-9.0, 9.0]] * 2, dtype=F64),
)
DATA = np.array([[400.0, 5.0], [5.0, 0.5]])  # the second number hardly shows
SEEN = np.array([0.3, -2.0])


def ended(information: np.ndarray, misfit: float, chi2: float = 1.0) -> ShootingFit:
    """Where a fit of Gaussian data with this information about `SEEN` ends."""
    own = np.diag(1 / PRIOR.std.numpy() ** 2)
    covariance = np.linalg.inv(information + own)
    estimate = covariance @ (information @ SEEN + own @ PRIOR.mean.numpy())
    nothing = torch.zeros(1, 1, 3, dtype=F64)
    shot = ShootingFit(
        shared=torch.tensor(estimate),
        covariance=torch.tensor(covariance),
        state=State(nothing, torch.zeros(1, 1, 4, dtype=F64), nothing, nothing),
        cost=1.0,
        costs=[1.0],
        misfit=misfit,
        chi2=chi2,
        converged=True,
    )
    return ShootingFit(**{**vars(shot), "covariance": shot.scale * shot.covariance})


def test_data_that_the_model_explains_keep_their_weight() -> None:
    shot = ended(DATA, misfit=0.0)
    estimate, covariance, growth = tempered(shot, PRIOR, EXCESS)
    assert growth == 1.0
    assert estimate == pytest.approx(shot.shared.numpy(), abs=1e-12)
    assert covariance == pytest.approx(shot.covariance.numpy(), abs=1e-12)


@pytest.mark.parametrize(("misfit", "chi2"), [(0.3, 1.0), (0.3, 2.5), (4.0, 1.0)])
def test_it_is_the_posterior_of_data_with_so_much_less_information(misfit: float, chi2: float) -> None:
    estimate, covariance, growth = tempered(ended(DATA, misfit, chi2), PRIOR, EXCESS)
    assert growth == pytest.approx(max(1.0, misfit, chi2) * (1 + EXCESS * misfit))
    less = ended(DATA / growth, 0.0)
    assert estimate == pytest.approx(less.shared.numpy(), rel=1e-9)
    assert covariance == pytest.approx(less.covariance.numpy(), rel=1e-9)


def test_what_hardly_shows_returns_to_its_prior_and_what_shows_well_stays() -> None:
    shot = ended(DATA, misfit=1.0)
    estimate, covariance, _ = tempered(shot, PRIOR, EXCESS)
    assert abs(estimate[1] - 1.0) < 0.1 < abs(float(shot.shared[1]) - 1.0)
    assert abs(estimate[0] - 0.3) < 0.1
    assert np.sqrt(covariance[1, 1]) < 0.6  # no wider than the prior


def test_data_without_information_leave_the_prior() -> None:
    estimate, covariance, _ = tempered(ended(np.zeros((2, 2)), misfit=2.0), PRIOR, EXCESS)
    assert estimate == pytest.approx(PRIOR.mean.numpy(), abs=1e-12)
    assert covariance == pytest.approx(np.diag(PRIOR.std.numpy() ** 2), rel=1e-12)


def test_bounds_hold() -> None:
    tight = ShootingPrior(PRIOR.mean, PRIOR.std, torch.tensor([[-9.0, 9.0], [0.97, 9.0]], dtype=F64))
    assert tempered(ended(DATA, misfit=1.0), tight, EXCESS)[0][1] >= 0.97


@pytest.mark.parametrize(("misfit", "share"), [(0.0, 0.0), (0.25, 0.25), (1.0, 1.0), (7.0, 1.0)])
def test_frictions_alone_have_the_error_of_the_law(misfit: float, share: float) -> None:
    pair = replace(FRICTION, name="friction[fingertip,object]")
    covariance = np.array([[0.04, 0.01, 0.02], [0.01, 0.09, 0.0], [0.02, 0.0, 0.16]])
    wider = with_friction_law_error(covariance, [FRICTION, CONTACT_TIME, pair], misfit * FRICTION_LAW_MISFIT)
    law = share * FRICTION_LAW_STD**2
    assert wider == pytest.approx(covariance + np.diag([law, 0.0, law]))
