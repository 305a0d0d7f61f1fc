"""Gains of an effect in held-out rebounds beside a rebound that depends on slip.

Where the ground gives way along the surface, the friction of an impact and its rebound are coupled: balls that slip
rebound less, and the first impact of a throw, the fastest, is the one that slips. The effect then has to predict what
slip does not: log e = a + b q + c q^2 + d x is fitted to the other episodes, with and without x, q = s / (s + v) for a
slip s and a speed v before the impact, and x the effect's change of the logarithm of the rebound. What an episode gains
is the fall of the deviance of its prediction, with the errors of the coefficients: where it alone has an impact that
slips, the others say nothing of what slip does, and its rebound is predicted by neither.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from ...segments.impact_law import point_velocity
from ...segments.impacts.fit import REBOUND_SHARE, ImpactBase, ImpactFit, ImpactProblem
from ...trajectories.segmentation import GroundPlane

Array = NDArray[np.float64]

WEAK = 1.0
"""Standard deviation of the prior of b, c and d: a rebound changes by less than a factor of three."""


def gains_beside_slip(base: ImpactBase, problem: ImpactProblem, fit: ImpactFit, spread: float = 1.0) -> Array:
    """Return the fall of each held-out episode's deviance by an effect, where slip may change the rebound, too.

    Args:
        base: The fit without the effect.
        problem: The same impacts with the effect.
        fit: Their fit with it.
        spread: Factor by which variances exceed those of the measurement.
    """
    seen, world = problem.impacts, problem.world
    normal = GroundPlane.of(world).normal
    reach = world.bodies[0].radii[:, :1] if seen.reach_m is None else seen.reach_m[:, None]
    arm = (-reach * normal).expand(len(seen), 3)
    before, after = (point_velocity(twist, arm) for twist in (seen.before, seen.after))
    speed, rise = -(before @ normal), after @ normal
    slip = (before - (before @ normal)[:, None] * normal).norm(dim=-1)
    left = [
        one.residuals(torch.as_tensor(f.values)[None])[0, :, 0] for one, f in ((base.problem, base.fit), (problem, fit))
    ]
    without, changed = ((rise - one).clamp_min(1e-3).log() for one in left)
    seen_up = [
        torch.einsum("i,nij,j->n", normal, c[:, :3, :3], normal)
        for c in (seen.covariance_before, seen.covariance_after)
    ]
    variance = seen_up[0] / speed.square() + seen_up[1] / rise.square() + REBOUND_SHARE**2
    share = slip / (slip + speed).clamp_min(1e-6)
    columns = torch.stack([torch.ones_like(share), share, share.square(), changed - without], 1)
    usable = (speed > 0) & (rise > 0)
    rows, value = columns[usable].numpy(), (rise / speed).clamp_min(1e-6).log()[usable].numpy()
    sigma = (spread * variance[usable]).sqrt().numpy()
    return held_out_gains(rows, value, sigma, seen.episode[usable.numpy()])


def held_out_gains(rows: Array, value: Array, sigma: Array, episode: NDArray[np.int64]) -> Array:
    """Return the fall of the deviance of each episode by the last column, with coefficients from the other episodes.

    The only episode is predicted by none: its fall is 0.

    Args:
        rows: Columns, the constant first, shape (n, P).
        value: What is predicted, shape (n,).
        sigma: Its standard deviations, shape (n,).
        episode: Episode of each row, shape (n,).
    """
    gains = []
    for own in np.unique(episode):
        held = episode == own
        if held.all():
            return np.zeros(1)
        without, beside = (
            _deviance(rows[:, :count], value, sigma, held) for count in (rows.shape[1] - 1, rows.shape[1])
        )
        gains.append(without - beside)
    return np.array(gains)


def _deviance(rows: Array, value: Array, sigma: Array, held: NDArray[np.bool_]) -> float:
    """Return twice the negative logarithm of the likelihood of held rows (n,), predicted from the others."""
    weighted = rows[~held] / sigma[~held, None]
    prior = np.diag([0.0, *([1 / WEAK**2] * (rows.shape[1] - 1))])
    covariance = np.linalg.inv(weighted.T @ weighted + prior)
    missed = value[held] - rows[held] @ (covariance @ weighted.T @ (value[~held] / sigma[~held]))
    predicted = rows[held] @ covariance @ rows[held].T + np.diag(sigma[held] ** 2)
    return float(missed @ np.linalg.solve(predicted, missed) + np.linalg.slogdet(predicted)[1])
