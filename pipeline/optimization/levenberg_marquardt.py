"""Robust Levenberg-Marquardt for shared parameters and one hidden state for each observed item.

The normal equations have arrow structure: the state of an item is coupled only to that item's residuals and the shared
parameters. Eliminating the states (Schur complement) leaves a small system in the parameters (Triggs et al., "Bundle
adjustment - a modern synthesis", 2000, section 6).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ...schemas import NotConvergedError

Residuals = Callable[[Tensor, Tensor, bool], tuple[Tensor, Tensor | None]]
"""(shared (P,), state change (B, S), with Jacobian) -> residuals (B, F, m) in sigmas, and (B, F, m, P + S) or None.

The robust loss gives each row of F (a frame) one weight; an unobserved row is zero.
"""


@dataclass(frozen=True, kw_only=True)
class Solution:
    """Result of a fit."""

    shared: Tensor
    """Shared parameters (P,)."""
    states: Tensor
    """Changes (B, S) from the initial states."""
    cost: float
    """Cost at the end."""
    costs: list[float]
    """Cost at the start and after each iteration that lowered it."""
    information: Tensor
    """Information (P, P) on the shared parameters, states eliminated."""
    scores: Tensor
    """Negative gradient (B, P) of half of each item's cost, states eliminated."""
    state_cov: Tensor
    """Covariance (B, S, S) of the states at fixed parameters."""
    chi2: Tensor
    """Squared norm (B, F) of each row of residuals, in sigmas."""
    converged: bool
    """Whether the fit converged within the given number of iterations."""
    free: Tensor
    """Mask (P,) of the parameters that are not on a bound."""
    by_item: Tensor
    """Contribution (B, P, P) of each item to the information."""


def robust_loss(chi2: Tensor, scale: float | None) -> tuple[Tensor, Tensor]:
    """Return the Cauchy loss and the weight of rows with the given squared norms; plain squares without a scale.

    rho = c^2 log(1 + chi2 / c^2), weight = 1 / (1 + chi2 / c^2).
    """
    if scale is None:
        return chi2, torch.ones_like(chi2)
    ratio = chi2 / scale**2
    return scale**2 * torch.log1p(ratio), 1 / (1 + ratio)


def bound_stops(shared: Tensor, downhill: Tensor, bounds: Tensor) -> Tensor:
    """Return the mask (P,) of parameters that a bound stops: those on it where the cost falls beyond it.

    Args:
        shared: The parameters, shape (P,).
        downhill: The negative gradient of the cost with respect to them, shape (P,).
        bounds: Lower and upper bounds, shape (P, 2).
    """
    return ((shared <= bounds[:, 0]) & (downhill < 0)) | ((shared >= bounds[:, 1]) & (downhill > 0))


def minimise(
    residuals: Residuals,
    shared: Tensor,
    states: Tensor,
    bounds: Tensor,
    *,
    robust_scale: float | None = None,
    iterations: int = 25,
    tolerance: float = 1e-4,
    prior_information: Tensor | None = None,
    shared_prior: tuple[Tensor, Tensor] | None = None,
    on_iteration: Callable[[int, float], None] | None = None,
) -> Solution:
    """Minimise the robust sum of squares over shared parameters and item states.

    Args:
        residuals: See `Residuals`.
        shared: Start of the parameters, shape (P,), P may be 0.
        states: Start of the state changes, shape (B, S), S may be 0.
        bounds: Lower and upper bounds of the parameters, shape (P, 2).
        robust_scale: Scale c of the Cauchy loss of a row, in sigmas; None for plain squares.
        iterations: Maximum number of accepted and rejected steps.
        tolerance: Stop when the cost falls by less than this fraction.
        prior_information: Information (S,), or (B, S), of a zero-mean prior on each state change.
        shared_prior: Center (P,) and information (P,) of a prior on the parameters, not part of the result.
        on_iteration: Called with the iteration and the cost.

    Raises:
        NotConvergedError: If the residuals at the start are not finite.
    """
    prior = torch.zeros(states.shape[1]).to(states) if prior_information is None else prior_information
    centre, held = (torch.zeros_like(shared), torch.zeros_like(shared)) if shared_prior is None else shared_prior
    damping, costs, converged = 1e-3, [], False
    linear = _linearise(residuals, shared, states, robust_scale, prior)
    if not torch.isfinite(linear.cost):
        raise NotConvergedError("the model diverges already at the start of the fit (no finite residual).")
    total = linear.cost + _pull(shared, centre, held)
    costs.append(float(total))
    for iteration in range(iterations):
        step_shared, step_states = _step(linear, shared, bounds, damping, held, held * (centre - shared))
        next_shared = (shared + step_shared).clamp(bounds[:, 0], bounds[:, 1])
        next_states = states + step_states
        cost = _cost(residuals, next_shared, next_states, robust_scale, prior) + _pull(next_shared, centre, held)
        if torch.isfinite(cost) and cost < total:
            fall = float((total - cost) / total.clamp_min(1e-300))
            shared, states = next_shared, next_states
            linear = _linearise(residuals, shared, states, robust_scale, prior)
            total = linear.cost + _pull(shared, centre, held)
            costs.append(float(total))
            damping = max(damping / 5, 1e-8)
            if fall < tolerance:
                converged = True
        else:
            damping *= 6
            converged = damping > 1e8
        if on_iteration:
            on_iteration(iteration, costs[-1])
        if converged:
            break
    return _solution(linear, shared, states, bounds, costs, converged)


@dataclass(frozen=True, kw_only=True)
class _Linear:
    """Normal equations of one linearization."""

    a: Tensor
    """Information (B, S, S) on the states, with their prior."""
    b: Tensor
    """Mixed information (B, S, P) on states and parameters."""
    c: Tensor
    """Information (B, P, P) on the parameters."""
    ga: Tensor
    """Negative gradient (B, S) of half of the cost with respect to the states."""
    gc: Tensor
    """Negative gradient (B, P) of half of the cost with respect to the parameters."""
    cost: Tensor
    """Cost, a scalar."""
    chi2: Tensor
    """Squared norm (B, F) of each row of residuals."""


def _pull(shared: Tensor, centre: Tensor, information: Tensor) -> Tensor:
    """Return the cost of a normal prior on the shared parameters, twice the negative log density."""
    return (information * (shared - centre).square()).sum()


def _cost(residuals: Residuals, shared: Tensor, states: Tensor, scale: float | None, prior: Tensor) -> Tensor:
    """Return the robust cost with the prior on the states."""
    r, _ = residuals(shared, states, False)
    return robust_loss(r.square().sum(-1), scale)[0].sum() + (prior * states.square()).sum()


def _linearise(residuals: Residuals, shared: Tensor, states: Tensor, scale: float | None, prior: Tensor) -> _Linear:
    """Return the robust normal equations of all items."""
    r, jacobian = residuals(shared, states, True)
    assert jacobian is not None  # it was requested
    chi2 = r.square().sum(-1)
    loss, weight = robust_loss(chi2, scale)
    count = shared.shape[0]
    # derivatives of rows that are not finite are not used: the cost already rejects them
    weighted = jacobian * weight[..., None, None]
    flat, flat_weighted, flat_r = jacobian.flatten(1, 2), weighted.flatten(1, 2), r.flatten(1, 2)
    normal = flat_weighted.transpose(1, 2) @ flat
    gradient = -(flat_weighted.transpose(1, 2) @ flat_r[..., None]).squeeze(-1)
    a = normal[:, count:, count:] + torch.diag_embed(prior)
    ga = gradient[:, count:] - prior * states
    cost = loss.sum() + (prior * states.square()).sum()
    return _Linear(
        a=a,
        b=normal[:, count:, :count],
        c=normal[:, :count, :count],
        ga=ga,
        gc=gradient[:, :count],
        cost=cost,
        chi2=chi2,
    )


def _eliminate(linear: _Linear, damping: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Eliminate the states, and return reduced information and gradient by item and the back-substitution."""
    diagonal = torch.diag_embed(linear.a.diagonal(dim1=1, dim2=2).clamp_min(1e-12))
    a = linear.a + damping * diagonal
    solved = torch.linalg.solve(a, torch.cat((linear.b, linear.ga[..., None]), -1))
    by_shared, by_gradient = solved[..., :-1], solved[..., -1]
    reduced = linear.c - linear.b.transpose(1, 2) @ by_shared
    gradient = linear.gc - (linear.b.transpose(1, 2) @ by_gradient[..., None]).squeeze(-1)
    return reduced, gradient, by_shared, by_gradient


def _step(
    linear: _Linear, shared: Tensor, bounds: Tensor, damping: float, held: Tensor, pull: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the damped step of the parameters and the states.

    Args:
        linear: The normal equations.
        shared: Shared parameters (P,).
        bounds: Lower and upper bounds (P, 2).
        damping: Relative damping.
        held: Information (P,) of the prior on the parameters.
        pull: Negative gradient (P,) of half of its cost.
    """
    reduced, gradient, by_shared, by_gradient = _eliminate(linear, damping)
    total, slope = reduced.sum(0) + torch.diag(held), gradient.sum(0) + pull
    free = (~bound_stops(shared, slope, bounds)).to(shared.dtype)
    scale = total.diagonal().clamp_min(1e-9)
    system = total * free[:, None] * free + torch.diag(damping * scale + (1 - free) * scale + 1e-9)
    step = torch.linalg.solve(system, slope * free) if shared.numel() else shared
    return step, by_gradient - (by_shared @ step[:, None]).squeeze(-1)


def _solution(
    linear: _Linear, shared: Tensor, states: Tensor, bounds: Tensor, costs: list[float], converged: bool
) -> Solution:
    """Return the solution at the last linearization."""
    reduced, gradient, _, _ = _eliminate(linear, 1e-9)
    free = (shared > bounds[:, 0]) & (shared < bounds[:, 1])
    eye = torch.eye(linear.a.shape[-1]).to(linear.a)
    state_cov = torch.linalg.pinv(linear.a, hermitian=True) if linear.a.shape[-1] else linear.a * eye
    return Solution(
        shared=shared,
        states=states,
        cost=costs[-1],
        costs=costs,
        information=reduced.sum(0),
        scores=gradient,
        state_cov=state_cov,
        chi2=linear.chi2,
        converged=converged,
        free=free,
        by_item=reduced,
    )
