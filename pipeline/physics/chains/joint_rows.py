"""Limits and dry friction of joints as rows of the contact solver: one-sided, and with a bound on both sides.

A limit is a contact in the joint's own coordinate: the law of `contact_law.py` with a natural time of `LIMIT_TIME_S`
and critical damping. After each iteration over the contacts the rows are solved one after another (Gauss-Seidel).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..contact_law import coefficients
from .dynamics import ChainDynamics, ChainMotion, Kick

LIMIT_TIME_S, LIMIT_RATIO = 0.002, 1.0
"""Natural time [s] and damping ratio of a joint at its limit: a stiff stop without rebound."""
OPEN_SPEED = 1e30
"""Target speed of a limit that is not reached, below any real one, with its sign."""


@dataclass(frozen=True, kw_only=True)
class JointRows:
    """Rows of the joints of a chain in one step; n items, J joints."""

    body: int
    """Index of the chain's root in the world, under which its generalised velocity is collected."""
    rows: Tensor
    """Mass-weighted rows (n, J, nv): joint speed by generalised velocity times the root of A."""
    speed: Tensor
    """Speeds without contact [rad/s or m/s], shape (n, J)."""
    target: Tensor
    """Speeds that the lower and the upper limit ask for away from it, shape (n, J, 2)."""
    friction: Tensor
    """Largest impulse of dry friction [N m s or N s], shape (n, J)."""
    active: tuple[bool, ...]
    """Whether a joint has a limit or dry friction, shape (J,)."""

    @staticmethod
    def of(dynamics: ChainDynamics, body: int, motion: ChainMotion, kick: Kick, step_s: Tensor) -> JointRows:
        """Prepare the rows of a chain."""
        speed = kick.speed[:, dynamics.base_size :]
        h = step_s[:, None]
        lower, upper, friction = (dynamics.numbers[name] for name in ("lower", "upper", "friction"))
        time, ratio = torch.full_like(h, LIMIT_TIME_S), torch.full_like(h, LIMIT_RATIO)
        k, d = coefficients(time, ratio, h)
        target = torch.stack(
            [
                _target(sign * (motion.values - bound), sign * speed, h, k, d)
                for sign, bound in ((1, lower), (-1, upper))
            ],
            -1,
        )
        limited = torch.isfinite(lower) | torch.isfinite(upper) | (friction > 0)
        return JointRows(
            body=body,
            rows=kick.inverse_root[:, :, dynamics.base_size :].transpose(-1, -2),
            speed=speed,
            target=target,
            friction=(h * friction).expand_as(speed),
            active=tuple(limited.any(0).tolist()),
        )

    def solve(self, before: Tensor, moved: Tensor) -> tuple[Tensor, Tensor]:
        """Return the impulses after one pass over the joints, and the motion that all impulses then make.

        Args:
            before: Impulses (n, J, 3): of the lower limit, the upper limit (both 0 or more), and of friction.
            moved: Change (n, nv, 1) of the mass-weighted generalised velocity under all impulses, these included.
        """
        columns = list(before.unbind(1))
        for j, active in enumerate(self.active):
            if not active:
                continue
            row = self.rows[:, j]
            mass = 1 / row.square().sum(-1)
            below, above, rubbed = columns[j].unbind(-1)
            speed = self.speed[:, j] + (row * moved[..., 0]).sum(-1)
            new_below = (below + mass * (self.target[:, j, 0] - speed)).clamp_min(0.0)
            speed = speed + (new_below - below) / mass
            new_above = (above + mass * (self.target[:, j, 1] + speed)).clamp_min(0.0)
            speed = speed - (new_above - above) / mass
            limit = self.friction[:, j]
            new_rubbed = torch.maximum(torch.minimum(rubbed - mass * speed, limit), -limit)
            change = (new_below - below) - (new_above - above) + (new_rubbed - rubbed)
            moved = moved + (row * change[:, None])[..., None]
            columns[j] = torch.stack((new_below, new_above, new_rubbed), -1)
        return torch.stack(columns, 1) if columns else before, moved

    def motion(self, impulses: Tensor) -> Tensor:
        """Return the change (n, nv, 1) of the mass-weighted generalised velocity under impulses (n, J, 3)."""
        along = impulses[..., 0] - impulses[..., 1] + impulses[..., 2]
        return self.rows.transpose(-1, -2) @ along[..., None]


def _target(gap: Tensor, speed: Tensor, h: Tensor, k: Tensor, d: Tensor) -> Tensor:
    """Return the speed that a limit asks for, as `ContactGroup.of` does for a contact."""
    finite = torch.isfinite(gap)
    gap = torch.where(finite, gap, torch.ones_like(gap))
    ahead = gap + h * speed
    closing = (h * speed.abs()).clamp_min(1e-12)
    closed = torch.where(gap > 0, (-ahead / closing).clamp(0.0, 1.0), torch.ones_like(gap))
    demand = -d * closed * speed - k * ahead.clamp_max(0.0) / h
    touching = finite & ((gap < 0) | (ahead < 0))
    return torch.where(touching, speed + demand, torch.full_like(gap, -OPEN_SPEED))
