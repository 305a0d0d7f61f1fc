"""Robust fit of shared parameters and one hidden state for each observed item, from a function of their residuals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ...schemas import NotConvergedError
from .least_squares import Descent, Policy, Stop, descend
from .problem import Box, NormalEquations, Point, Problem, Rows

Residuals = Callable[[Tensor, Tensor, bool], tuple[Tensor, Tensor | None]]
"""(shared (P,), state change (B, S), with Jacobian) -> residuals (B, F, m) in sigmas, and (B, F, m, P + S) or None.

The robust loss gives each row of F (a frame) one weight; an unobserved row is zero.
"""


LAST_DAMPING = 1e-9
"""Damping of the states in the information of the result: it is invertible even where a state was not observed."""


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
    stop: Stop
    """Why the fit ended."""
    free: Tensor
    """Mask (P,) of the parameters that are not on a bound."""
    by_item: Tensor
    """Contribution (B, P, P) of each item to the information."""

    @property
    def converged(self) -> bool:
        """Whether the fit converged within the given number of iterations."""
        return self.stop in (Stop.CONVERGED, Stop.NO_LOWER_COST)


def robust_loss(chi2: Tensor, scale: float | None) -> tuple[Tensor, Tensor]:
    """Return the Cauchy loss and the weight of rows with the given squared norms; plain squares without a scale.

    rho = c^2 log(1 + chi2 / c^2), weight = 1 / (1 + chi2 / c^2).
    """
    if scale is None:
        return chi2, torch.ones_like(chi2)
    ratio = chi2 / scale**2
    return scale**2 * torch.log1p(ratio), 1 / (1 + ratio)


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
    damp_states: bool = True,
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
        damp_states: Whether the states are damped, too; not where residuals are linear in them.

    Raises:
        NotConvergedError: If the residuals at the start are not finite.
    """
    zero = torch.zeros_like(shared)
    centre, held = (zero, zero) if shared_prior is None else shared_prior
    prior = torch.zeros(states.shape[1]).to(states) if prior_information is None else prior_information
    box = Box.within(bounds, centre, held)
    problem = _SharedAndStates(residuals, robust_scale, prior, box, states.new_zeros(len(states), dtype=torch.long))
    policy = Policy(iterations=iterations, relative=tolerance, damp_states=damp_states)
    report = None if on_iteration is None else lambda step, descent: on_iteration(step, float(descent.cost[0]))
    end = descend(problem, Point(values=shared[None], states=(states,)), policy, report)
    if not bool(end.history[0].isfinite()):
        raise NotConvergedError(
            "the model diverges already at the start of the fit (no finite residual).",
            todo="check the units of the tracks and the shape of the bodies, or start from another model: --from.",
        )
    return _solution(problem, end)


@dataclass(frozen=True)
class _SharedAndStates(Problem):
    """Residuals of items (B) that all share their parameters, as one group."""

    residuals: Residuals
    """Residuals and their Jacobian."""
    robust_scale: float | None
    """Scale of the Cauchy loss of a row, in sigmas; None for plain squares."""
    prior: Tensor
    """Information (S,), or (B, S), of a zero-mean prior on each state change."""
    box: Box
    """Bounds and prior of the shared parameters."""
    owner: Tensor
    """Zeros (B,)."""

    def costs(self, point: Point, rows: Rows) -> Tensor:
        """Return the cost (B,) of each item, with the prior on its state."""
        del rows
        found, _ = self.residuals(point.values[0], point.states[0], False)
        return self._item_costs(robust_loss(found.square().sum(-1), self.robust_scale)[0], point.states[0])

    def linearised(self, point: Point, rows: Rows) -> NormalEquations:
        """Return the robust normal equations of all items."""
        del rows
        shared, states = point.values[0], point.states[0]
        found, jacobian = self.residuals(shared, states, True)
        assert jacobian is not None  # it was requested
        loss, weight = robust_loss(found.square().sum(-1), self.robust_scale)
        normal = NormalEquations.of_rows(
            found.flatten(1),
            jacobian.flatten(1, 2),
            len(shared),
            self._item_costs(loss, states),
            weight.repeat_interleave(found.shape[-1], -1),
            self.prior,
        )
        return replace(normal, state_slope=normal.state_slope - self.prior * states)

    def _item_costs(self, loss: Tensor, states: Tensor) -> Tensor:
        return loss.sum(-1) + (self.prior * states.square()).sum(-1)


def _solution(problem: _SharedAndStates, end: Descent) -> Solution:
    """Return the end of a descent as a solution."""
    shared, states, normal = end.point.values[0], end.point.states[0], end.normal
    assert isinstance(normal, NormalEquations)  # as the problem makes them
    reduced = normal.eliminated(torch.full_like(normal.cost, LAST_DAMPING))
    bounds = problem.box
    rows, _ = problem.residuals(shared, states, False)
    return Solution(
        shared=shared,
        states=states,
        cost=end.costs[-1],
        costs=end.costs,
        information=reduced.information.sum(0),
        scores=reduced.score,
        state_cov=torch.linalg.pinv(normal.states, hermitian=True) if states.shape[1] else normal.states,
        chi2=rows.square().sum(-1),
        stop=end.reasons[0],
        free=(shared > bounds.low[0]) & (shared < bounds.high[0]),
        by_item=reduced.information,
    )
