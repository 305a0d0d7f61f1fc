"""Joint fits of chosen parameters and the states of all segments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..optimization.least_squares import Policy, descend
from ..optimization.problem import Box, NormalEquations, Point, Problem, Rows
from ..physics.parameters import Parameter, apply_parameters
from ..physics.state import State
from ..physics.world import World
from .candidates import base_values
from .segment_states import best_of, normal_equations
from .segments import Segments
from .thresholds import SEGMENT_THRESHOLDS

Array = NDArray[np.float64]

ITERATIONS = 6
"""Maximum number of steps."""
FALL = 0.05
"""Fall of the cost below which a refit ends: a twentieth of a standard error of one parameter."""
FALL_SHARE = 1e-3
"""The same as a share of the cost: where the law misses far more than the noise, smaller changes are roughness."""
ROBUST_EXCESS = SEGMENT_THRESHOLDS.preparation.robust_excess
"""Scale k of rho(e) = 2 k log(1 + e / 2k) for the excess e = chi2 - dof of a contact segment: the error of the contact
law in an impact is one error, not one in each frame (study of diagnosis, section 3)."""
LEAST_WEIGHT = 1e-12
"""Minimum weight of a contact segment."""


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
    """The parts, with their states, in the world with the estimates."""
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
    free: Sequence[str] = (),
) -> Refit:
    """Fit parameters and states, starting close to the solution.

    Args:
        parts: Flight and contact segments, or one of them, with fitted states.
        world: The model's world, with the effects that are fitted.
        parameters: What is fitted in addition to the states; priors are centred on the world's values.
        start: Values to start from (P,), in fitted coordinates; None for the world's values.
        iterations: Maximum number of steps.
        free: Names of parameters without a prior.
    """
    centre = base_values(world, parameters)
    values = centre if start is None else start
    prior = torch.tensor([0.0 if p.name in free else 1 / p.prior[1] ** 2 for p in parameters]).to(centre)
    bounds = torch.tensor([p.limits for p in parameters]).reshape(-1, 2).to(centre)
    problem = _JointProblem([part.in_world(world) for part in parts], parameters, bounds, centre, prior)
    policy = Policy(
        iterations=iterations,
        up=20.0,
        least_damping=0.0,
        most_damping=1e4,
        damp_states=False,
        absolute=FALL,
        relative=FALL_SHARE,
    )
    states = [part.observations.state for part in problem.parts]
    point = Point(values=values[None], states=State.joined(*states).tensors)
    end = descend(problem, point, policy)
    found = world
    if parameters:
        columns = torch.stack([p.decode(end.point.values[0, k]) for k, p in enumerate(parameters)])[None]
        found = apply_parameters(world, parameters, columns)
    return Refit(
        world=found,
        parameters=tuple(parameters),
        values=end.point.values[0],
        covariance=torch.linalg.pinv(end.information()[0], hermitian=True),
        segments=tuple(part.in_world(found) for part, _ in problem.at(end.point)),
        cost=float(end.cost[0]),
        by_segment=end.item_cost.split(problem.sizes),
    )


class _JointProblem(Problem):
    """Parameters (P) shared by parts of segments, and the states of these (B in all parts together).

    Args:
        parts: Flight and contact segments, or one of them, in the world that is fitted.
        parameters: What is fitted in addition to the states.
        bounds: Lower and upper bounds of the parameters, shape (P, 2).
        centre: Centres of their priors, shape (P,).
        prior: Information of their priors, shape (P,).
    """

    derivatives_with_costs = True

    def __init__(
        self, parts: Sequence[Segments], parameters: Sequence[Parameter], bounds: Tensor, centre: Tensor, prior: Tensor
    ) -> None:
        self.parts, self.parameters = parts, parameters
        self.sizes = [len(part.items) for part in parts]
        self.owner = torch.zeros(sum(self.sizes), dtype=torch.long)
        self.box = Box.within(bounds, centre, prior)

    def at(self, point: Point) -> list[tuple[Segments, slice]]:
        """Return the parts in their states, and where each lies among all segments."""
        state, first, found = State(*point.states), 0, []
        for part, size in zip(self.parts, self.sizes, strict=True):
            own = slice(first, first + size)
            found.append((part.with_state(state.at(own)), own))
            first += size
        return found

    def linearised(self, point: Point, rows: Rows) -> NormalEquations:
        """Return the normal equations of all segments; contact segments are weighted robustly."""
        del rows
        found = []
        for part, _ in self.at(point):
            error, jacobian = part.residuals(self.parameters, point.values[0])
            normal = normal_equations(part, error, jacobian, len(self.parameters))
            if part.kind == "contact":
                loss, weight = robust_excess(normal.cost - part.dof)
                # a weight of 0, of a diverged rollout, would leave the state's equations singular
                normal = replace(normal.weighted(weight.clamp_min(LEAST_WEIGHT)), cost=loss)
            found.append(normal)
        return NormalEquations.joined(found)

    def moved(self, point: Point, values: Tensor, step: Tensor, rows: Rows) -> tuple[Tensor, ...]:
        """Return the states that go with moved parameters (1, P); step (B, S)."""
        del rows
        states = []
        for part, own in self.at(point):
            after = part.moved(step[own])
            # through contact, states do not always follow in a straight line
            if part.kind == "contact":
                after = best_of(part, [after.observations.state], self.parameters, values[0])
            states.append(after.observations.state)
        return State.joined(*states).tensors


@dataclass(frozen=True, kw_only=True)
class Linear:
    """Segments (B) linearised at their states and at given values of the parameters (P), with the states eliminated."""

    information: Tensor
    """Information M_i = Jp'Jp - B_i' A_i^-1 B_i in fitted coordinates, shape (B, P, P)."""
    score: Tensor
    """Score g_i = -(Jp'r - B_i' A_i^-1 Jx'r), shape (B, P)."""
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
    found = normal_equations(segments, rows, jacobian, count).eliminated()
    return Linear(information=found.information, score=found.score, chi2=rows.square().sum((1, 2)), dof=segments.dof)


def robust_excess(excess: Tensor) -> tuple[Tensor, Tensor]:
    """Return the loss rho and the weight rho' of excesses e = chi2 - dof, any shape: e below 0, a logarithm above."""
    above = excess.clamp_min(0.0) / (2 * ROBUST_EXCESS)
    loss = torch.where(excess < 0, excess, 2 * ROBUST_EXCESS * torch.log1p(above))
    return loss, 1 / (1 + above)
