"""Joint fits of chosen parameters and the states of all segments, by damped Gauss-Newton."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..optimization.levenberg_marquardt import bound_stops
from ..physics.parameters import Parameter, apply_parameters
from ..physics.world import World
from ..trajectories.residuals import state_prior
from .candidates import base_values
from .segment_states import best_of
from .segments import Segments

Array = NDArray[np.float64]

ITERATIONS = 6
"""Maximum number of steps."""
FALL = 0.05
"""Fall of the cost below which a refit ends: a twentieth of a standard error of one parameter."""
FALL_SHARE = 1e-3
"""The same as a share of the cost: where the law misses far more than the noise, smaller changes are roughness."""
ROBUST_EXCESS = 20.0
"""Scale k of rho(e) = 2 k log(1 + e / 2k) for the excess e = chi2 - dof of a contact segment: the error of the contact
law in an impact is one error, not one in each frame (study of diagnosis, section 3)."""


@dataclass(frozen=True, kw_only=True)
class Refit:
    """The result of a refit."""

    world: World
    """World with the estimates."""
    parameters: tuple[Parameter, ...]
    """Fitted parameters (P)."""
    values: Tensor
    """Estimates in fitted coordinates, shape (P,)."""
    covariance: Tensor
    """Covariance in fitted coordinates, shape (P, P)."""
    segments: tuple[Segments, ...]
    """The parts, with their states."""
    cost: float
    """Chi2 of flight, plus rho of the excess of contact, plus the priors."""
    by_segment: tuple[Tensor, ...]
    """The cost of each segment, by part."""

    def number(self, name: str) -> tuple[float, float]:
        """Return estimate and standard error of a parameter, in its unit."""
        k = [p.name for p in self.parameters].index(name)
        p = self.parameters[k]
        estimate = float(p.decode(self.values[k]))
        return estimate, float(self.covariance[k, k].clamp_min(0.0).sqrt()) * (estimate if p.logarithmic else 1.0)


def refit(
    parts: Sequence[Segments],
    world: World,
    parameters: Sequence[Parameter],
    start: Tensor | None = None,
    iterations: int = ITERATIONS,
) -> Refit:
    """Fit parameters and states, starting close to the solution.

    Args:
        parts: Flight and contact segments, or one of them, with fitted states.
        world: The model's world, with the effects that are fitted.
        parameters: What is fitted in addition to the states; priors are centred on the world's values.
        start: Values to start from (P,), in fitted coordinates; None for the world's values.
        iterations: Maximum number of steps.
    """
    centre = base_values(world, parameters)
    values = centre if start is None else start
    prior = torch.tensor([1 / p.prior[1] ** 2 for p in parameters]).to(centre)
    bounds = torch.tensor([p.limits for p in parameters]).reshape(-1, 2).to(centre)
    parts = [part.in_world(world) for part in parts]
    linears = [linearised(part, parameters, values) for part in parts]
    cost, damping = _cost(parts, linears, values, centre, prior), 1e-3
    for _ in range(iterations):
        matrix, slope = _normal(parts, linears)
        matrix = matrix + torch.diag(prior)
        slope = slope - prior * (values - centre)
        step = _step(matrix, slope, values, bounds, damping)
        moved = (values + step).clamp(bounds[:, 0], bounds[:, 1])
        trial = [
            _following(part, linear, parameters, values, moved) for part, linear in zip(parts, linears, strict=True)
        ]
        seen = [linearised(part, parameters, moved) for part in trial]
        found = _cost(trial, seen, moved, centre, prior)
        if found < cost:
            fall, cost, damping = cost - found, found, damping / 5
            parts, linears, values = trial, seen, moved
            if fall < max(FALL, FALL_SHARE * cost):
                break
        else:
            damping *= 20
            if damping > 1e4:
                break
    return _refitted(world, parameters, parts, linears, values, prior, cost)


def _following(
    part: Segments, linear: Linear, parameters: Sequence[Parameter], values: Tensor, moved: Tensor
) -> Segments:
    """Return segments with the states that go with parameters moved from `values` to `moved` (P,)."""
    after = part.moved(linear.state_step - (linear.by_parameter @ (moved - values)))
    # through contact, states do not always follow in a straight line
    return best_of(part, [after.observations.state], parameters, moved) if after.kind == "contact" else after


def _refitted(
    world: World,
    parameters: Sequence[Parameter],
    parts: Sequence[Segments],
    linears: Sequence[Linear],
    values: Tensor,
    prior: Tensor,
    cost: float,
) -> Refit:
    """Return the end of a descent: the world with the values (P,), and their covariance."""
    matrix, _ = _normal(parts, linears)
    covariance = torch.linalg.pinv(matrix + torch.diag(prior), hermitian=True)
    columns = torch.stack([p.decode(values[k]) for k, p in enumerate(parameters)])[None] if parameters else None
    return Refit(
        world=world if columns is None else apply_parameters(world, parameters, columns),
        parameters=tuple(parameters),
        values=values,
        covariance=covariance,
        segments=tuple(parts),
        cost=cost,
        by_segment=tuple(_losses(part, linear) for part, linear in zip(parts, linears, strict=True)),
    )


def _losses(part: Segments, linear: Linear) -> Tensor:
    """Return the cost (B,) of each segment; infinite where a rollout diverged."""
    chi2 = torch.nan_to_num(linear.chi2, nan=torch.inf, posinf=torch.inf)
    return chi2 if part.kind == "flight" else robust_excess(chi2 - linear.dof)[0]


def _cost(parts: Sequence[Segments], linears: Sequence[Linear], values: Tensor, centre: Tensor, prior: Tensor) -> float:
    """Return the cost of all segments and of the priors."""
    data = sum(float(_losses(part, linear).sum()) for part, linear in zip(parts, linears, strict=True))
    return data + float((prior * (values - centre).square()).sum())


def _normal(parts: Sequence[Segments], linears: Sequence[Linear]) -> tuple[Tensor, Tensor]:
    """Return information and score of all parts, contact segments weighted robustly."""
    matrix, slope = [], []
    for part, linear in zip(parts, linears, strict=True):
        weight = linear.weight if part.kind == "contact" else None
        matrix.append(summed(linear.information, weight))
        slope.append(summed(linear.score, weight))
    return torch.stack(matrix).sum(0), torch.stack(slope).sum(0)


def _step(matrix: Tensor, slope: Tensor, values: Tensor, bounds: Tensor, damping: float) -> Tensor:
    """Return a damped step; a parameter that a bound stops does not move."""
    free = (~bound_stops(values, slope, bounds)).to(slope)
    damped = torch.diag(damping * matrix.diagonal() + (1 - free))
    return torch.linalg.solve(matrix * free[:, None] * free + damped, slope * free)


@dataclass(frozen=True, kw_only=True)
class Linear:
    """Segments (B) linearised at their states and at given values of the parameters (P), with the states eliminated."""

    information: Tensor
    """Information M_i = Jp'Jp - B_i' A_i^-1 B_i in fitted coordinates, shape (B, P, P)."""
    score: Tensor
    """Score g_i = -(Jp'r - B_i' A_i^-1 Jx'r), shape (B, P)."""
    state_step: Tensor
    """Step of the states without a change of the parameters, shape (B, S)."""
    by_parameter: Tensor
    """Change of the states with the parameters: these move by d, the states by state_step - by_parameter d; shape (B,
    S, P)."""
    chi2: Tensor
    """Chi-square of each segment, shape (B,)."""
    dof: Tensor
    """Degrees of freedom of each segment, shape (B,)."""

    @property
    def weight(self) -> Tensor:
        """The robust weight (B,) of each segment."""
        return robust_excess(self.chi2 - self.dof)[1]


def linearised(segments: Segments, parameters: Sequence[Parameter], values: Tensor) -> Linear:
    """Return the linearization of segments at values (P,) or (B, P) in fitted coordinates."""
    rows, jacobian = segments.residuals(parameters, values)
    return projected(segments, rows, jacobian, len(parameters))


def projected(segments: Segments, rows: Tensor, jacobian: Tensor, count: int) -> Linear:
    """Return the linearization from residuals (B, F, 6) and their Jacobian (B, F, 6, P + S), with P = count."""
    error = torch.nan_to_num(rows.flatten(1), posinf=0.0, neginf=0.0)
    flat = torch.nan_to_num(jacobian.flatten(1, 2), posinf=0.0, neginf=0.0)
    by_value, by_state = flat[..., :count], flat[..., count:]
    prior = torch.diag(state_prior(len(segments.observations.free))).to(error)
    states = by_state.transpose(1, 2) @ by_state + prior
    mixed = by_state.transpose(1, 2) @ by_value
    slope = (by_state.transpose(1, 2) @ error[..., None]).squeeze(-1)
    solved = torch.linalg.solve(states, torch.cat((mixed, slope[..., None]), -1))
    by_parameter, state_step = solved[..., :-1], -solved[..., -1]
    information = by_value.transpose(1, 2) @ by_value - mixed.transpose(1, 2) @ by_parameter
    score = -(by_value.transpose(1, 2) @ error[..., None]).squeeze(-1) - (
        mixed.transpose(1, 2) @ state_step[..., None]
    ).squeeze(-1)
    return Linear(
        information=information,
        score=score,
        state_step=state_step,
        by_parameter=by_parameter,
        chi2=rows.square().sum((1, 2)),
        dof=segments.dof,
    )


def robust_excess(excess: Tensor) -> tuple[Tensor, Tensor]:
    """Return the loss rho and the weight rho' of excesses e = chi2 - dof, any shape: e below 0, a logarithm above."""
    above = excess.clamp_min(0.0) / (2 * ROBUST_EXCESS)
    loss = torch.where(excess < 0, excess, 2 * ROBUST_EXCESS * torch.log1p(above))
    return loss, 1 / (1 + above)


def summed(values: Tensor, weight: Tensor | None = None) -> Tensor:
    """Return the sum over segments (B, ...) with weights (B,)."""
    if weight is None:
        return values.sum(0)
    return (values * weight.view(-1, *[1] * (values.ndim - 1))).sum(0)
