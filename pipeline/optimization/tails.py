"""Tail probabilities and quantiles of the distributions of test statistics.

`scipy.special` has them, too, but its import takes as long as a hundred fits of small problems.

Sources: Abramowitz & Stegun (1964), 26.6.2 and 26.7.1, for F and t by the incomplete beta function; DLMF 8.17.22 for
its continued fraction, evaluated by Lentz's method (Press et al., "Numerical recipes", 2007, sections 5.2 and 6.4).
"""

from __future__ import annotations

import math
from statistics import NormalDist

import torch

_TINY, _DIGITS = 1e-300, 1e-16
"""Smallest factor of a continued fraction, and relative change at which it ends."""
_MOST_TERMS, _MOST_STEPS = 100_000, 500
"""Maximum number of terms of a continued fraction, and of steps to a quantile."""


def chi2_tail(statistic: float, dof: float) -> float:
    """Return the probability that chi2 with `dof` degrees of freedom exceeds a statistic."""
    half = torch.tensor([0.5 * dof, 0.5 * max(statistic, 0.0)], dtype=torch.float64)
    return float(torch.special.gammaincc(half[0], half[1]))


def f_tail(statistic: float, dof_above: float, dof_below: float) -> float:
    """Return the probability that Fisher's F with the given degrees of freedom exceeds a statistic."""
    above = dof_above * max(statistic, 0.0)
    return beta_share(0.5 * dof_below, 0.5 * dof_above, dof_below, above)


def normal_tail(z: float) -> float:
    """Return the probability that a standard normal variable exceeds z."""
    return 0.5 * math.erfc(z / math.sqrt(2))


def student_tail(t: float, dof: float) -> float:
    """Return the probability that Student's t with `dof` degrees of freedom exceeds a value."""
    beyond = 0.5 * beta_share(0.5 * dof, 0.5, dof, t * t)
    return beyond if t >= 0 else 1 - beyond


def student_quantile(probability: float, dof: float) -> float:
    """Return the quantile of Student's t with `dof` degrees of freedom, for a probability in (0, 1).

    Newton's method from the normal quantile, which is smaller in the upper half: there the distribution function is
    concave, so that every step ends below the quantile.
    """
    beyond = min(probability, 1 - probability)
    t = -NormalDist().inv_cdf(beyond)
    scale = math.exp(math.lgamma(0.5 * (dof + 1)) - math.lgamma(0.5 * dof)) / math.sqrt(math.pi * dof)
    for _ in range(_MOST_STEPS):
        step = (student_tail(t, dof) - beyond) / (scale * (1 + t * t / dof) ** (-0.5 * (dof + 1)))
        t += step
        if abs(step) <= 1e-15 * abs(t):
            break
    return t if probability > 0.5 else -t


def beta_share(a: float, b: float, left: float, right: float) -> float:
    """Return the regularised incomplete beta function I_x(a, b) at x = left / (left + right); both are 0 or more.

    The two parts of the interval are given, as 1 - x loses all digits where one is small.
    """
    if left <= 0 or right <= 0:
        return 0.0 if left <= 0 else 1.0
    x, rest = left / (left + right), right / (left + right)
    size = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x) + b * math.log(rest)
    if x < (a + 1) / (a + b + 2):
        return math.exp(size) * _fraction(a, b, x) / a
    return 1 - math.exp(size) * _fraction(b, a, rest) / b


def _fraction(a: float, b: float, x: float) -> float:
    """Return the continued fraction of I_x(a, b), without its factor; it converges fast for x < (a + 1)/(a + b + 2)."""
    above, below = 1.0, 1 / _large(1 - (a + b) * x / (a + 1))
    found = below
    for m in range(1, _MOST_TERMS):
        even = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m))
        odd = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))
        for term in (even, odd):
            below, above = 1 / _large(1 + term * below), _large(1 + term / above)
            found *= above * below
        if abs(above * below - 1) < _DIGITS:
            break
    return found


def _large(x: float) -> float:
    return x if abs(x) > _TINY else _TINY
