"""Tail probabilities and quantiles; from `scipy.special`, as `scipy.stats` alone takes half a second to import."""

from __future__ import annotations

from scipy.special import chdtrc, fdtrc, ndtr, stdtrit


def chi2_tail(statistic: float, dof: float) -> float:
    """Return the probability that chi2 of `dof` degrees of freedom exceeds a statistic."""
    return float(chdtrc(dof, max(statistic, 0.0)))


def f_tail(statistic: float, dof_above: float, dof_below: float) -> float:
    """Return the probability that Fisher's F of these degrees of freedom exceeds a statistic."""
    return float(fdtrc(dof_above, dof_below, max(statistic, 0.0)))


def normal_tail(z: float) -> float:
    """Return the probability that a standard normal number exceeds z."""
    return float(ndtr(-z))


def student_quantile(probability: float, dof: float) -> float:
    """Return the quantile of Student's t of `dof` degrees of freedom."""
    return float(stdtrit(dof, probability))
