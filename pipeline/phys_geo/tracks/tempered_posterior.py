"""Data that a model cannot follow weigh less, in the estimate as in its interval."""

from __future__ import annotations

import numpy as np

from .shooting import Prior, Shot


def tempered(shot: Shot, prior: Prior, excess: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return estimate (P,) and covariance (P, P) after the data's information is divided by what the model misses.

    Where the ties do not hold, the errors of the frames are those of the model: they are not independent, and the
    curvature of the fit counts them as if they were. With the information divided by g = max(1, misfit, chi2) *
    (1 + excess * misfit), the prior regains its share:

        C = (H / g + P)^-1,    z = C ((H z0 + P (z0 - m)) / g + P m)

    H: information of the data at the fit's end z0 (curvature less the prior's); P, m: the prior's information and mean.
    A number that these data hardly show then stands near the middle of its prior instead of where the model's errors
    pushed it. Tempered likelihood: e.g. Grünwald and van Ommen, Bayesian Analysis 12 (2017); the Gaussian form is
    derived here. With misfit 0 and chi2 1 nothing changes.

    Args:
        shot: Where the fit ended.
        prior: That of the fit.
        excess: By how much a unit of misfit multiplies the variances, beyond itself.

    Returns:
        Estimate, covariance, and g.
    """
    growth = shot.scale * (1 + excess * shot.misfit)
    ended, middle = shot.shared.numpy(), prior.mean.numpy()
    own = np.diag(1 / np.square(prior.std.numpy()))
    information = np.linalg.pinv(shot.covariance.numpy() / shot.scale, hermitian=True) - own
    values, axes = np.linalg.eigh((information + information.T) / 2)
    information = (axes * values.clip(0.0)) @ axes.T  # below 0 it is rounding: the prior was all there was
    covariance = np.linalg.inv(information / growth + own)
    pulled = (information @ ended + own @ (ended - middle)) / growth + own @ middle
    low, high = prior.bounds.numpy().T
    return (covariance @ pulled).clip(low, high), covariance, growth
