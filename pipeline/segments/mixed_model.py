"""Linear mixed model: parameters of all groups with a shared normal prior, by expectation-maximisation.

A parameter of group u is normally distributed about the mean over groups, with a standard deviation tau that is
estimated too (Laird & Ware, "Random-effects models for longitudinal data", 1982). A group with little information is
shrunk towards the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..optimization.levenberg_marquardt import Solution
from ..physics.parameters import Parameter
from ..trajectories.correlated_noise import WindowErrors
from .group_parameters import group_of

Array = NDArray[np.float64]

ROUNDS = 300
"""Number of iterations of expectation-maximisation."""
LEAST_SHARE = 1e-3
"""Lower bound of tau, as a share of the widest prior: where groups do not differ, tau would go to 0."""


@dataclass(frozen=True)
class GroupPrior:
    """The prior of group-specific parameters that a fit has found."""

    mean: Mapping[str, float]
    """Mean over groups, by `effect.parameter`."""
    spread: Mapping[str, float]
    """Standard deviation between groups in fitted coordinates, by `effect.parameter`."""


@dataclass(frozen=True, kw_only=True)
class GroupLayout:
    """The place of every parameter of every group in one vector of N values, with the widest priors."""

    parameters: list[Parameter]
    """Parameters (P)."""
    groups: list[list[str]]
    """Groups of each parameter, in the order of their values; one empty name for a parameter shared by all."""
    place: NDArray[np.int64]
    """Index of the value that each item uses, shape (B, P)."""
    owner: NDArray[np.int64]
    """Index of the parameter of each value, shape (N,)."""
    centre: Array
    """Prior means in fitted coordinates, shape (N,)."""
    width: Array
    """Widest prior standard deviations, shape (N,)."""

    @staticmethod
    def of(
        start: Sequence[tuple[Parameter, float]],
        episodes: Sequence[str],
        groups: Mapping[str, str],
        ties: GroupPrior | None,
    ) -> GroupLayout:
        """Lay out parameters, with the values that they start from, for items of the given episodes (B)."""
        parameters = [p for p, _ in start]
        units = [[group_of(p.shared, name, groups) for name in episodes] for p in parameters]
        names = [list(dict.fromkeys(column)) for column in units]
        first = np.cumsum([0, *(len(column) for column in names)])
        place = np.stack([[first[k] + names[k].index(u) for u in column] for k, column in enumerate(units)], 1)
        owner = np.repeat(np.arange(len(parameters)), [len(column) for column in names])
        given = {p.name: p.encode(value) for p, value in start} | dict(ties.mean if ties else {})
        return GroupLayout(
            parameters=parameters,
            groups=names,
            place=place,
            owner=owner,
            centre=np.array([given[parameters[k].name] for k in owner]),
            width=np.array([parameters[k].prior[1] for k in owner]),
        )

    def places(self, parameter: int) -> NDArray[np.int64]:
        """Return the indices of the values of a parameter."""
        return np.flatnonzero(self.owner == parameter)

    def tied(self) -> list[NDArray[np.int64]]:
        """Return the indices of the values of each parameter that differs between groups."""
        return [self.places(k) for k, p in enumerate(self.parameters) if p.shared != "all"]

    def known_tau(self, ties: GroupPrior) -> Array:
        """Return the prior standard deviations (N,) that an earlier fit has found."""
        return np.array([ties.spread.get(self.parameters[k].name, self.width[i]) for i, k in enumerate(self.owner)])


@dataclass(frozen=True, kw_only=True)
class GroupPosterior:
    """Values of all groups (N) with their estimated prior."""

    values: Array
    """Values in fitted coordinates, shape (N,)."""
    covariance: Array
    """Their covariance, shape (N, N)."""
    mean: Array
    """Prior means, shape (N,)."""
    tau: Array
    """Prior standard deviations, shape (N,)."""
    dof: float
    """Degrees of freedom."""
    errors: Array
    """Factor by which the error variance of each item exceeds that of independent errors, shape (B,)."""


def posterior(solution: Solution, errors: WindowErrors, layout: GroupLayout, known_tau: Array | None) -> GroupPosterior:
    """Return parameters and priors that maximise the likelihood of the linearised problem.

    The error variance is that found with the widest prior: shrunk groups fit worse, and would be weighted down for it.

    Args:
        solution: The descent with the widest priors, at which the problem is linearised.
        errors: Chi-square and effective sample size of each item (B).
        layout: The values (N) with their widest priors.
        known_tau: Prior standard deviations (N,) of an earlier fit; None to estimate them.
    """
    centre, width, tied = layout.centre, layout.width, layout.tied()
    parts, slopes, at = solution.by_item.numpy(), solution.scores.numpy(), solution.shared.numpy()
    factor = _factors(parts, slopes, at, errors, centre, width)
    matrix = (parts / factor[:, None, None]).sum(0)
    right = ((slopes + parts @ at) / factor[:, None]).sum(0)
    mean, tau = centre.copy(), width.copy() if known_tau is None else known_tau
    values, covariance = _solved(matrix, right, mean, tau)
    for _ in range(ROUNDS if known_tau is None else 0):
        for places in tied:
            if len(places) > 1:
                mean[places] = values[places].mean()
                square = ((values[places] - mean[places]) ** 2 + np.diag(covariance)[places]).sum() / (len(places) - 1)
                tau[places] = np.clip(np.sqrt(square), LEAST_SHARE * width[places], width[places])
        values, covariance = _solved(matrix, right, mean, tau)
    dof = float(errors.independent.sum()) - len(values)
    return GroupPosterior(values=values, covariance=covariance, mean=mean, tau=tau, dof=max(dof, 1.0), errors=factor)


def _factors(parts: Array, slopes: Array, at: Array, errors: WindowErrors, centre: Array, width: Array) -> Array:
    """Return the factor (B,) by which the error variance of each item exceeds that of independent errors."""
    factor = np.ones(len(parts))
    for _ in range(10):
        matrix = (parts / factor[:, None, None]).sum(0)
        right = ((slopes + parts @ at) / factor[:, None]).sum(0)
        values, covariance = _solved(matrix, right, centre, width)
        away = values - at
        chi2 = errors.chi2 - 2 * slopes @ away + np.einsum("p,bpq,q->b", away, parts, away)
        lost = np.einsum("pq,bqp->b", covariance, parts) / factor
        free = errors.independent - lost
        for k in np.unique(errors.kind):
            some = errors.kind == k
            pooled = max(chi2[some].sum(), 1e-12) / max(free[some].sum(), 1.0)
            # an episode that fits worse than the others gets less weight
            factor[some] = np.maximum(pooled, chi2[some] / np.maximum(free[some], 1.0))
    return factor


def _solved(matrix: Array, right: Array, mean: Array, tau: Array) -> tuple[Array, Array]:
    """Return the posterior mean and covariance of a linear problem with a normal prior."""
    covariance = np.linalg.inv(matrix + np.diag(tau**-2.0))
    return (covariance @ (right + mean / tau**2)).astype(np.float64), covariance.astype(np.float64)
