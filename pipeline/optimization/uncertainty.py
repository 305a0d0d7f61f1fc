"""Covariances and correlations of estimates."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...schemas import Correlation
from .tails import student_quantile

Array = NDArray[np.float64]


def scaled_pinv(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pseudo-inverse of a symmetric matrix, computed after scaling to a unit diagonal."""
    scale = np.sqrt(np.clip(np.diag(matrix), 1e-300, None))
    return np.linalg.pinv(matrix / np.outer(scale, scale), hermitian=True) / np.outer(scale, scale)


LEAST_INFORMATION, ROUNDING = 1e-30, 1e-10
"""Minimum information of a parameter, and minimum eigenvalue of the scaled information matrix as a share of the
largest; smaller values are raised to these."""


LEAST_DOF = 1.0
"""Fewest degrees of freedom: a number that one episode alone tells has none."""
ENOUGH_EPISODES = 8
"""Minimum number of episodes from which their scatter alone determines the intervals."""


def correlation_of(names: Sequence[str], covariance: Array) -> Correlation:
    """Return the correlations of fitted coordinates with a covariance (P, P), in the form of `model.json`."""
    std = np.sqrt(np.clip(np.diag(covariance), 1e-300, None))
    # of parameters that do the same it is 1, which rounding may exceed, and otherwise on the two sides of the diagonal
    matrix = np.clip(0.5 * (covariance + covariance.T) / np.outer(std, std), -1.0, 1.0)
    return Correlation(parameters=tuple(names), matrix=tuple(map(tuple, matrix.tolist())))


def few_covariance(information: Array, scores: Array, prior: Array | None = None) -> Array:
    """Return the covariance (P, P) of estimates from few episodes.

    With `ENOUGH_EPISODES` or more it is that of the scatter between episodes (Huber 1967), with the corrections for
    small samples: n / (n - 1), and Student's t instead of the normal distribution, both of which eight episodes need.
    With fewer, the scatter may be small by chance, so each variance is at least that of the curvature, which follows
    from the noise. The curvature alone would be far too narrow, because a model error affects all frames of an episode
    alike.

    Args:
        information: Information (P, P).
        scores: Gradient of each episode (E, P).
        prior: Part (P, P) of the information that comes from a prior. It has no gradient in any episode, so it is added
            to the scatter; otherwise a parameter that no episode shows would seem exact.
    """
    curvature = inverse(information)
    count = len(scores)
    if count < 2:
        return curvature
    # as a square, which rounding leaves with variances above 0 where parameters do nearly the same
    parts = [curvature @ scores.T * math.sqrt(count / (count - 1)) * student_quantile(0.975, count - 1) / REACH]
    if prior is not None:
        sizes, directions = np.linalg.eigh(prior)
        parts.append(curvature @ (directions * np.sqrt(sizes.clip(0.0))))
    scatter = sum((part @ part.T for part in parts), np.zeros_like(curvature))
    return scatter if count >= ENOUGH_EPISODES else raised(curvature, scatter)


def student_reach(information: Array, covariance: Array) -> Array:
    """Return by how much more standard errors intervals have to reach where few of many episodes tell a number.

    What scatters between n episodes that tell as much has n - 1 degrees of freedom. Where some tell more than others,
    the number is that of as many alike: the square of the sum of what each adds, over the sum of squares (Satterthwaite
    1946). `few_covariance` has Student's t for all episodes; this is the ratio to it of that for those that count.

    Args:
        information: Information of each episode, shape (E, P, P).
        covariance: Inverse of the information of all (P, P).
    """
    told = np.einsum("kp,epq,kq->ek", covariance, information, covariance)
    shares = told / told.sum(0).clip(1e-300)
    alike = 1 / np.square(shares).sum(0).clip(1.0 / len(shares))
    dof = np.clip(alike - 1, LEAST_DOF, None)
    usual = student_quantile(0.975, max(len(information) - 1, LEAST_DOF))
    return np.array([max(student_quantile(0.975, float(n)) / usual, 1.0) for n in dof])


def raised(covariance: Array, other: Array) -> Array:
    """Return a covariance (P, P) with variances raised to those of another where larger, and unchanged correlations."""
    width = np.sqrt(np.maximum(1.0, np.diag(other) / np.diag(covariance).clip(1e-300)))
    return covariance * np.outer(width, width)


def inverse(information: Array) -> Array:
    """Return the inverse of an information matrix (P, P), with a large positive variance in unmeasured directions.

    The elimination of states may leave a direction with a slightly negative information, by rounding.
    """
    scale = np.sqrt(np.diag(information).clip(LEAST_INFORMATION))
    sizes, directions = np.linalg.eigh(information / np.outer(scale, scale))
    sizes = sizes.clip(ROUNDING * max(float(sizes[-1]), 1.0))
    return (directions / sizes) @ directions.T / np.outer(scale, scale)


REACH = 1.96
"""Half width of a 95 % interval of a normal variable, in standard errors."""


def size_interval(size: float, std: float) -> tuple[float, float]:
    """Return the 95 % interval of a size, which is 0 or more, with a normal error."""
    return max(size - REACH * std, 0.0), size + REACH * std
