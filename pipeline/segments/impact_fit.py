"""Fits of impacts: restitution, friction and an effect shared by all of them, by Gauss-Newton."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..physics.contact import ContactLaw
from ..physics.effects.effect import changed_by_effects
from ..physics.parameters import CONTACT_TIME, DAMPING_RATIO, FRICTION, Parameter, apply_parameters
from ..physics.sweeps import tangent_axes
from ..physics.world import World
from .impact_law import Impact, after_impact, point_velocity, rebound_speed
from .impacts import Impacts

Array = NDArray[np.float64]

REBOUND_SHARE = 0.03
"""Of its rebound an impact scatters by this share about any law (on development seeds, where nothing is hidden, 0.7 to
5 %): without it the few impacts of a capture could pass for exact."""
FRICTION_SHARE, IMPULSE_SHARE, SPIN_SHARE = 0.04, 0.002, 0.06
"""And its impulse along the ground by these shares of itself and of that along the normal, for a slip that ends leaves
some per cent; its change of spin by that share of itself, for the ground gives way and the arm is shorter."""
BASE = (FRICTION, CONTACT_TIME, DAMPING_RATIO)
STEP = 0.02
"""Differences by parameters, in widths of their priors."""
TWIST_STEPS = (1e-3, 1e-2)
"""Differences by velocity [m/s] and angular velocity [rad/s]."""
ITERATIONS, FALL = 12, 0.02
SHARES = (1.0, 0.4, 0.1)


@dataclass(frozen=True)
class ImpactFit:
    """Impacts fitted by a world: values (P,), information (P, P), residuals (n, 6) in sigmas.

    The first residual of an impact is that of the rebound, the others are of what lies along the ground and of spin.
    """

    values: Array
    information: Array
    rows: Array
    prior: float

    @property
    def chi2(self) -> Array:
        """Chi2 (2,) of the rebounds and of the rest."""
        square = self.rows**2
        return np.array([square[:, 0].sum(), square[:, 1:].sum()])


@dataclass(frozen=True, eq=False)
class ImpactProblem:
    """Impacts with the world of their candidate, and what whitens their residuals (n, 6, 6)."""

    world: World
    parameters: tuple[Parameter, ...]
    impacts: Impacts
    whitening: Tensor | None = None

    def residuals(self, values: Tensor, before: Tensor | None = None, after: Tensor | None = None) -> Tensor:
        """Return measured less predicted twists (K, n, 6) of K values (K, P): rebound, two along the ground, spin.

        [m/s] all: the spin as the speed of the surface.
        """
        seen, count = self.impacts, len(values)
        before = seen.before.repeat(count, 1) if before is None else before
        after = seen.after.repeat(count, 1) if after is None else after
        decoded = torch.stack([p.decode(values[:, k]) for k, p in enumerate(self.parameters)], -1)
        items = decoded.repeat_interleave(len(before) // count, 0)
        world = changed_by_effects(apply_parameters(self.world, self.parameters, items))
        normal, law = world.ground_normal, world.contact
        assert normal is not None and isinstance(law, ContactLaw)
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
        seen, body = self.impacts, world.bodies[0]
        times = len(before) // len(seen)
        turn = seen.rotation.repeat(times, 1, 1)
        normal = world.ground_normal
        assert normal is not None
        count = len(before)
        arm = -body.radii[:, :1] * normal - (turn @ body.com[..., None])[..., 0]
        return Impact(
            before,
            torch.zeros(count).to(before),
            seen.place.repeat(times, 1),
            turn,
            arm.expand(count, 3),
            turn @ body.inertia @ turn.mT,
            body.mass.expand(count),
            normal,
            -(world.gravity @ normal).expand(count),
            body,
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
        """Return the covariance (n, 6, 6) of what no law of an impact tells."""
        seen, world = self.impacts, changed_by_effects(self.world)
        impact, normal = self._impact(world, seen.before), world.ground_normal
        assert normal is not None
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
        """Return residuals (K, n, 6) in sigmas."""
        assert self.whitening is not None
        found = (self.whitening @ self.residuals(values)[..., None])[..., 0]
        return torch.nan_to_num(found, nan=1e6, posinf=1e6, neginf=-1e6)

    def linear(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """Return residuals (n, 6) in sigmas at a value (P,), and their differences (n, 6, P) by the parameters."""
        steps = STEP * torch.tensor([p.prior[1] for p in self.parameters]).to(value)
        high = torch.tensor([p.limits[1] for p in self.parameters]).to(value)
        # towards the inside, where a step up would leave the bounds
        steps = torch.where(value + steps > high, -steps, steps)
        rows = self.rows(torch.cat([value[None], value + torch.diag(steps)]))
        return rows[0], ((rows[1:] - rows[:1]) / steps[:, None, None]).movedim(0, -1)


def fit_impacts(
    problem: ImpactProblem, start: Tensor, weight: Array | None = None, centre: Tensor | None = None
) -> ImpactFit:
    """Fit the parameters of a problem to its impacts.

    Args:
        problem: With weights.
        start: Values (P,) in fitted coordinates.
        weight: How much each impact counts (n,); 1 by default.
        centre: Of the priors (P,); the start by default.
    """
    parameters = problem.parameters
    width = torch.tensor([p.prior[1] for p in parameters]).to(start)
    low, high = torch.tensor([p.limits for p in parameters]).to(start).T
    centre = start if centre is None else centre
    counts = np.ones(len(problem.impacts)) if weight is None else weight
    counted = torch.as_tensor(counts).to(start)[:, None].expand(-1, 6)

    def cost_of(rows: Tensor, value: Tensor) -> Tensor:
        return (counted * rows.square()).sum((-1, -2)) + ((value - centre) / width).square().sum(-1)

    value, cost = start, cost_of(problem.rows(start[None])[0], start)
    information = torch.diag(1 / width.square())
    for _ in range(ITERATIONS):
        rows, slope = problem.linear(value)
        slope, heavy = slope.flatten(0, 1), (counted[..., None] * slope).flatten(0, 1)
        information = slope.T @ heavy + torch.diag(1 / width.square())
        score = -(heavy.T @ rows.flatten()) - (value - centre) / width.square()
        blocked = ((value <= low) & (score < 0)) | ((value >= high) & (score > 0))
        moving = (~blocked).to(value)
        reduced = information * moving[:, None] * moving + torch.diag(1 - moving)
        step = torch.linalg.solve(reduced, score * moving)
        trials = torch.stack([(value + share * step).clamp(low, high) for share in SHARES])
        costs = cost_of(problem.rows(trials), trials)
        best = int(costs.argmin())
        fall = float(cost - costs[best])
        if fall > 0:
            value, cost = trials[best], costs[best]
        if fall < FALL:
            break
    rows = problem.rows(value[None])[0]
    prior = float(((value - centre) / width).square().sum())
    return ImpactFit(value.numpy(), information.numpy(), rows.numpy(), prior)
