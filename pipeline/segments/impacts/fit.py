"""Impact fit: restitution, friction and an effect shared by all impacts, by weighted least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...optimization.least_squares import Policy, descend
from ...optimization.problem import Box, NormalEquations, Point, Problem, Rows
from ...physics.effects.effect import changed_by_effects
from ...physics.impulse_solver import tangent_axes
from ...physics.parameters import CONTACT_TIME, DAMPING_RATIO, FRICTION, Parameter, apply_parameters
from ...physics.world import World
from ...trajectories.segmentation import GroundPlane
from ..candidates import Together, Variant, base_values, with_variants
from ..impact_law import Impact, after_impact, contact_law, point_velocity, rebound_speed
from ..sliding.fit import contact_effect_parameters
from ..thresholds import SEGMENT_THRESHOLDS
from .velocities import Impacts

LIMITS = SEGMENT_THRESHOLDS.impact_data

Array = NDArray[np.float64]

REBOUND_SHARE = LIMITS.rebound_share
"""Model error of an impact: standard deviation of the rebound speed as a share of itself (0.7 to 5 % without hidden
effects). Without it the few impacts of a capture could appear exact."""
FRICTION_SHARE, IMPULSE_SHARE, SPIN_SHARE = LIMITS.friction_share, LIMITS.impulse_share, LIMITS.spin_share
"""Model error of an impact: standard deviation of the tangential impulse (4 % of itself plus 0.2 % of the normal
impulse, because a slip that ends during the impact leaves some per cent) and of the change of spin (6 % of itself,
because the ground deforms and shortens the arm)."""
BASE = (FRICTION, CONTACT_TIME, DAMPING_RATIO)
"""Parameters of the contact law that every impact fit has."""
STEP = 0.02
"""Difference step by parameters, in widths of their priors."""
TWIST_STEPS = (1e-3, 1e-2)
"""Difference steps by velocity [m/s] and angular velocity [rad/s]."""
ITERATIONS, FALL = 12, 0.02
"""Maximum number of steps, and the fall of the cost below which a fit ends."""
SHARES = (1.0, 0.4, 0.1)
"""Lengths of a step that are tried."""
WEIGH_AGAIN = 2
"""Number of fits of the base, each with weights from the previous one."""


@dataclass(frozen=True)
class ImpactFit:
    """Impacts (n) fitted by a world with P parameters."""

    values: Array
    """Fitted parameters in fitted coordinates, shape (P,)."""
    information: Array
    """Information on the parameters including the priors, shape (P, P)."""
    rows: Array
    """Residuals in sigmas, shape (n, 6): first that of the rebound, then those along the ground and of the spin."""
    prior: float
    """Sum of squares of the priors."""

    @property
    def chi2(self) -> Array:
        """Chi2 (2,) of the rebounds and of the other residuals."""
        square = self.rows**2
        return np.array([square[:, 0].sum(), square[:, 1:].sum()])


@dataclass(frozen=True, eq=False)
class ImpactProblem:
    """Impacts (n) with the world of a candidate."""

    world: World
    """World with the candidate at its neutral values."""
    parameters: tuple[Parameter, ...]
    """What is fitted (P)."""
    impacts: Impacts
    """The measured impacts (n)."""
    whitening: Tensor | None = None
    """Inverse Cholesky factor of the residuals' covariance, shape (n, 6, 6); None until `whitened`."""

    def residuals(self, values: Tensor, before: Tensor | None = None, after: Tensor | None = None) -> Tensor:
        """Return measured less predicted twists (K, n, 6) [m/s] of values (K, P): rebound, two along the ground, spin.

        The spin is the speed of the surface.

        Args:
            values: In fitted coordinates (K, P).
            before: Twists before the impacts (K n, 6); the measured ones by default.
            after: Twists after the impacts (K n, 6); the measured ones by default.
        """
        seen, count = self.impacts, len(values)
        before = seen.before.repeat(count, 1) if before is None else before
        after = seen.after.repeat(count, 1) if after is None else after
        decoded = torch.stack([p.decode(values[:, k]) for k, p in enumerate(self.parameters)], -1)
        items = decoded.repeat_interleave(len(before) // count, 0)
        world = changed_by_effects(apply_parameters(self.world, self.parameters, items))
        normal, law = GroundPlane.of(world).normal, contact_law(world)
        impact = self._impact(world, before)
        point = point_velocity(torch.cat([after[:, :3] - before[:, :3], after[:, 3:] - before[:, 3:]], -1), impact.arm)
        mass = 1 / torch.einsum("i,nij,j->n", normal, impact.compliance, normal)
        impact = replace(impact, impulse=mass * (point @ normal))
        effects = tuple(a for a in world.effects if a.effect.phase == "contact")
        left = point_velocity(after, impact.arm) @ normal - rebound_speed(impact, law, effects)
        missed = after - after_impact(impact, law, effects)
        flat = missed[:, :3] @ tangent_axes(normal)[1:].T
        size = impact.arm.norm(dim=-1, keepdim=True)
        return torch.cat([left[:, None], flat, size * missed[:, 3:]], -1).unflatten(0, (count, -1))

    def _impact(self, world: World, before: Tensor) -> Impact:
        """Return the impacts of the given twists before (K n, 6) in a world, still without an impulse."""
        seen, body = self.impacts, world.bodies[0]
        times = len(before) // len(seen)
        turn = seen.rotation.repeat(times, 1, 1)
        normal = GroundPlane.of(world).normal
        count = len(before)
        if seen.reach_m is None:
            arm = -body.radii[:, :1] * normal - (turn @ body.com[..., None])[..., 0]
        else:
            arm = -seen.reach_m.repeat(times)[:, None] * normal
        return Impact(
            before=before,
            impulse=torch.zeros(count).to(before),
            place=seen.place.repeat(times, 1),
            rotation=turn,
            arm=arm.expand(count, 3),
            inertia=turn @ body.inertia @ turn.mT,
            mass=body.mass.expand(count),
            normal=normal,
            weight=-(world.gravity @ normal).expand(count),
            body=body,
        )

    def whitened(self, values: Tensor) -> ImpactProblem:
        """Return the problem with weights from the covariance of the twists, propagated at given values (P,)."""
        seen, n = self.impacts, len(self.impacts)
        steps = torch.tensor([step for step in TWIST_STEPS for _ in range(3)]).to(values)
        moves = torch.cat([torch.diag(steps), -torch.diag(steps)])
        still = torch.zeros_like(moves)
        first, second = torch.cat([moves, still]), torch.cat([still, moves])
        before = (seen.before + first[:, None]).flatten(0, 1)
        after = (seen.after + second[:, None]).flatten(0, 1)
        rows = self.residuals(values.expand(len(first), -1), before, after)
        slopes = [(part[:6] - part[6:]) / (2 * steps[:, None, None]) for part in (rows[:12], rows[12:])]
        cover = torch.zeros(n, 6, 6).to(values)
        for slope, own in zip(slopes, (seen.covariance_before, seen.covariance_after), strict=True):
            by_twist = slope.permute(1, 2, 0)
            cover = cover + by_twist @ own @ by_twist.mT
        whitening = torch.linalg.inv(torch.linalg.cholesky(cover + self._scatter()))
        return replace(self, whitening=whitening)

    def _scatter(self) -> Tensor:
        """Return the covariance (n, 6, 6) of the model error of an impact."""
        seen, world = self.impacts, changed_by_effects(self.world)
        impact, normal = self._impact(world, seen.before), GroundPlane.of(world).normal
        across = tangent_axes(normal)[1:]
        change = seen.after[:, :3] - seen.before[:, :3]
        along, up = (change @ across.T).norm(dim=-1), change @ normal
        width = FRICTION_SHARE * along + IMPULSE_SHARE * up  # (n,), per mass
        turns = torch.linalg.cross(impact.arm[:, None].expand(-1, 2, -1), across.expand(len(seen), 2, 3))
        spins = torch.linalg.solve(impact.inertia, turns.mT) * impact.mass[:, None, None]  # (n, 3, 2)
        size = impact.arm.norm(dim=-1)[:, None, None]
        by_push = torch.cat([torch.eye(2).to(size).expand(len(seen), 2, 2), size * spins], 1) * width[:, None, None]
        found = torch.zeros(len(seen), 6, 6).to(size)
        found[:, 1:, 1:] = by_push @ by_push.mT
        turned = SPIN_SHARE * size[:, 0, 0] * (seen.after[:, 3:] - seen.before[:, 3:]).norm(dim=-1)
        found[:, 3:, 3:] += turned.square()[:, None, None] * torch.eye(3).to(size)
        rebound = REBOUND_SHARE * (seen.after[:, :3] @ normal)
        found[:, 0, 0] = rebound.square()
        return found

    def rows(self, values: Tensor) -> Tensor:
        """Return residuals (K, n, 6) in sigmas.

        Raises:
            ValueError: If the problem has no weights.
        """
        if self.whitening is None:
            raise ValueError("the residuals have no weights yet: see `whitened`")
        found = (self.whitening @ self.residuals(values)[..., None])[..., 0]
        return torch.nan_to_num(found, nan=1e6, posinf=1e6, neginf=-1e6)

    def linear(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Return residuals (K, n, 6) in sigmas at values (K, P), and their derivatives (K, n, 6, P) by differences."""
        steps = self._steps(values)
        moved = torch.cat([values[:, None], values[:, None] + torch.diag_embed(steps)], 1)
        rows = self.rows(moved.flatten(0, 1)).unflatten(0, moved.shape[:2])
        return rows[:, 0], ((rows[:, 1:] - rows[:, :1]) / steps[:, :, None, None]).movedim(1, -1)

    def slopes(self, values: Tensor, columns: Tensor) -> Tensor:
        """Return the derivatives (n, 6, K) by one parameter each: columns (K,) at values (K, P) of equal residuals."""
        steps = self._steps(values).gather(1, columns[:, None])
        rows = self.rows(torch.cat([values[:1], values.scatter_add(1, columns[:, None], steps)]))
        return ((rows[1:] - rows[:1]) / steps[:, :, None]).movedim(0, -1)

    def _steps(self, values: Tensor) -> Tensor:
        """Return the difference steps (K, P) at values (K, P): inwards where a step up would leave the bounds."""
        steps = STEP * torch.tensor([p.prior[1] for p in self.parameters]).to(values)
        high = torch.tensor([p.limits[1] for p in self.parameters]).to(values)
        return torch.where(values + steps > high, -steps, steps)


def fit_impacts(problem: ImpactProblem, start: Tensor, centre: Tensor | None = None) -> ImpactFit:
    """Fit the parameters of a problem to its impacts.

    Args:
        problem: With weights.
        start: Values (P,) in fitted coordinates.
        centre: Centres of the priors (P,); the start by default.
    """
    every = np.ones((1, len(problem.impacts)))
    return fits_to_weighted(problem, start, every, start if centre is None else centre)[0]


def fits_to_weighted(problem: ImpactProblem, start: Tensor, weights: Array, centre: Tensor) -> list[ImpactFit]:
    """Fit the parameters of a problem to its impacts with several weights of each impact (G, n), all in one batch.

    Args:
        problem: With weights of the residuals.
        start: Values (P,) in fitted coordinates.
        weights: Weights of the impacts in each of the fits.
        centre: Centres of the priors (P,).
    """
    fitted = _WeightedImpacts(problem, torch.as_tensor(weights).to(start), centre)
    policy = Policy(
        iterations=ITERATIONS,
        damping=0.0,
        least_damping=0.0,
        shares=SHARES,
        attempts=1,
        absolute=FALL,
        linearise_end=False,
    )
    end = descend(fitted, Point(values=start.expand(len(weights), -1)), policy)
    values, costs = end.point.values, fitted.box.cost(end.point.values)
    parts = zip(values.numpy(), end.information().numpy(), problem.rows(values).numpy(), costs.tolist(), strict=True)
    return [ImpactFit(*part) for part in parts]


class _WeightedImpacts(Problem):
    """The parameters of a problem of impacts (n), once for each weighting of them (G).

    Args:
        problem: The problem, with weights of its residuals.
        weights: Weights of the impacts, shape (G, n).
        centre: Centres of the priors, shape (P,).
    """

    def __init__(self, problem: ImpactProblem, weights: Tensor, centre: Tensor) -> None:
        width = torch.tensor([p.prior[1] for p in problem.parameters]).to(centre)
        limits = torch.tensor([p.limits for p in problem.parameters]).to(centre)
        self.problem, self.weights = problem, weights[:, :, None].expand(-1, -1, 6)
        self.owner = torch.arange(len(weights))
        one = Box.within(limits, centre, 1 / width.square())
        self.box = one.at(torch.zeros(len(weights), dtype=torch.long))

    def costs(self, point: Point, rows: Rows) -> Tensor:
        """Return the weighted chi2 (g,) at points of one weighting each."""
        return (self.weights[rows.groups] * self.problem.rows(point.values).square()).sum((-1, -2))

    def linearised(self, point: Point, rows: Rows) -> NormalEquations:
        """Return the normal equations by the parameters."""
        found, slope = self.problem.linear(point.values)
        weight = self.weights[rows.groups]
        cost = (weight * found.square()).sum((-1, -2))
        return NormalEquations.of_rows(found.flatten(1), slope.flatten(1, 2), slope.shape[-1], cost, weight.flatten(1))


@dataclass(frozen=True, eq=False)
class ImpactBase:
    """The world without a candidate, fitted to the impacts: start and reference of every candidate."""

    problem: ImpactProblem
    """The impacts with their weights."""
    centre: torch.Tensor
    """Centres of the priors, shape (P,)."""
    fit: ImpactFit
    """The solution."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of the contact law and of the world's contact effects."""
        return self.problem.parameters

    @staticmethod
    def of(world: World, impacts: Impacts) -> ImpactBase:
        """Fit the contact parameters of a world to impacts."""
        known = contact_effect_parameters(world)
        # not the model's fitted values: a missing effect has biased them
        usual = torch.tensor([p.encode(p.prior[0]) for p in BASE]).to(world.gravity)
        parameters, centre = (*BASE, *known), torch.cat([usual, base_values(world, known)])
        problem, value = ImpactProblem(world, parameters, impacts), centre
        for _ in range(WEIGH_AGAIN):
            problem = problem.whitened(value)
            fit = fit_impacts(problem, value, centre)
            value = torch.as_tensor(fit.values)
        return ImpactBase(problem, centre, fit)

    def beside(self, variant: Variant) -> tuple[ImpactProblem, torch.Tensor]:
        """Return the problem with a candidate added, and values to start from."""
        world, own = with_variants(self.problem.world, [variant], "contact")
        zero = torch.zeros(len(own)).to(self.centre)
        problem = replace(self.problem, world=world, parameters=(*self.parameters, *own))
        return problem, torch.cat([torch.as_tensor(self.fit.values), zero])

    def beside_each(self, variants: Sequence[Variant]) -> tuple[ImpactProblem, Together, torch.Tensor]:
        """Return the problem with all candidates in it, these, and the values (P,) to start from, constants apart."""
        together = Together.of(self.problem.world, variants)
        problem = replace(self.problem, world=together.world, parameters=(*self.parameters, *together.parameters))
        start = torch.cat([torch.as_tensor(self.fit.values), base_values(together.world, together.parameters)])
        return problem, together, start

    def centre_of(self, start: torch.Tensor) -> torch.Tensor:
        """Return the centres of the priors of a problem with a candidate."""
        return torch.cat([self.centre, torch.zeros_like(start[len(self.centre) :])])

    def gains(self, problem: ImpactProblem, value: Array) -> Array:
        """Return the fall of each episode's chi2 by an effect whose parameters the other episodes determine."""
        episode = self.problem.impacts.episode
        names = np.unique(episode)
        others = (episode != names[:, None]).astype(np.float64)
        starts = torch.as_tensor(self.fit.values), torch.as_tensor(value)
        without = fits_to_weighted(self.problem, starts[0], others, self.centre)
        fitted = fits_to_weighted(problem, starts[1], others, self.centre_of(starts[1]))
        left = [[(one.rows[episode == own] ** 2).sum() for own, one in zip(names, fits, strict=True)]
                for fits in (without, fitted)]  # fmt: skip
        return np.array(left[0]) - np.array(left[1])
