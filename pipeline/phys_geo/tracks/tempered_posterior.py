"""Tempered posterior: data that the model cannot explain weigh less, in the estimate and in its interval."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...physics.parameters import FRICTION, Parameter, base_name
from .multiple_shooting import ShootingFit, ShootingPrior

FRICTION_LAW_STD = 0.1
"""Standard deviation of the logarithm of a friction that the law of contact makes itself, common to a whole motion, so
that no further frame makes it smaller. It is that of what MuJoCo (cone and pyramid), Drake, DART and Rapier state, from
one motion of each of 127 captures with true shape and mass: 113 intervals held without it, 118 with it."""
FRICTION_LAW_MISFIT = 0.1
"""Misfit of the ties from which on the law has all of that error; below, its variance is in proportion. Motions of
those engines have 0.10 in the middle, those of our own 0.05."""


def tempered(shot: ShootingFit, prior: ShootingPrior, excess: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return estimate (P,) and covariance (P, P) with the data's information reduced by the misfit of the model.

    Where the ties are violated, the residuals of the frames are errors of the model: they are not independent, while
    the curvature of the fit counts them as if they were. With the information divided by g = max(1, misfit, chi2) *
    (1 + excess * misfit), the prior regains its share:

        C = (H / g + P)^-1,    z = C ((H z0 + P (z0 - m)) / g + P m)

    H: information of the data at the fit's end z0 (curvature minus the prior's); P, m: information and mean of the
    prior. A parameter that these data hardly identify then ends near the mean of its prior instead of where the model's
    errors pushed it. Tempered likelihood: e.g. Grünwald and van Ommen, Bayesian Analysis 12 (2017); the Gaussian form
    is derived here. With misfit 0 and chi2 1 nothing changes.

    Args:
        shot: Result of the fit.
        prior: Prior of the fit.
        excess: Additional factor on the variances for each unit of misfit.

    Returns:
        Estimate, covariance, and g.
    """
    growth = shot.scale * (1 + excess * shot.misfit)
    ended, middle = shot.shared.numpy(), prior.mean.numpy()
    prior_information = np.diag(1 / np.square(prior.std.numpy()))
    information = np.linalg.pinv(shot.covariance.numpy() / shot.scale, hermitian=True) - prior_information
    values, axes = np.linalg.eigh((information + information.T) / 2)
    information = (axes * values.clip(0.0)) @ axes.T  # negative by rounding where only the prior contributes
    covariance = np.linalg.inv(information / growth + prior_information)
    pulled = (information @ ended + prior_information @ (ended - middle)) / growth + prior_information @ middle
    low, high = prior.bounds.numpy().T
    return (covariance @ pulled).clip(low, high), covariance, growth


def with_friction_law_error(covariance: np.ndarray, parameters: Sequence[Parameter], misfit: float) -> np.ndarray:
    """Return a covariance (P, P) of parameters with the error that the law of contact makes in each friction.

    Args:
        covariance: That of the parameters without this error, shape (P, P).
        parameters: The parameters (P).
        misfit: Mean square of the tied residuals of the fit, in standard deviations of the ties.
    """
    frictions = np.array([base_name(parameter.name) == FRICTION.name for parameter in parameters], float)
    return covariance + np.diag(FRICTION_LAW_STD**2 * min(1.0, misfit / FRICTION_LAW_MISFIT) * frictions)
