"""The closed-form, complementarity-free contact law: its numbers, and the points where bodies touch.

Source: the row rule of complementarity-free contact (arXiv 2408.07855) in its mass- and count-normalised form
(contact model notes, section 6; derived): for contact c with effective mass m_c and weight q_c,

    impulse_n = m_c q_c max(0, -(k + d) u_n - k gap / h)

u_n is the free velocity of the gap, h the step. tau and zeta are the contact's natural time and damping ratio, so the
material depends neither on mass, nor on the step, nor on how many spheres touch. Friction is applied to the
tangential velocity separately, inside the disc of radius friction * impulse_n, which avoids the lift and the
anisotropy of polyhedral rows. `sweeps.py` applies the law; `published.py` has the polyhedral form of the paper.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from ...schemas import InputDataError


@dataclass(frozen=True)
class ContactLaw:
    """The numbers of a contact, each of shape (1,) or (B,): friction [1], contact time [s], damping ratio [1]."""

    name: ClassVar[str] = "closed_form"
    friction: Tensor
    contact_time_s: Tensor
    damping_ratio: Tensor


@dataclass(frozen=True)
class Touch:
    """The points where two bodies may touch in a step, and the numbers of their contact, which effects may change.

    n items of the batch, C points each. ground: whether b is the ground; position (n, C, 3) [m], normal (n, C, 3)
    from b to a, both world frame; gap (n, C) [m], negative where they overlap; velocity (n, C, 3) [m/s] of a's point
    relative to b's without contact; spin_rad_s (n, 3): angular velocity of a relative to b; step_s (n, 1).

    The numbers have shape (n, 1) or (n, C): friction [1]; contact_time_s [s]; damping_ratio [1]; viscous_n_s_m
    [N s/m]: force against the slip, shared among the points that touch; rolling_m, torsion_m [m]: largest torque
    against rolling, and against spinning about the normal, in units of the normal force. anisotropy (n, 1 or C, 2) [1]:
    a and b of the friction by direction along `tangent_axes` of the normal, see `ellipse.py`.
    """

    ground: bool
    position: Tensor
    normal: Tensor
    gap: Tensor
    velocity: Tensor
    spin_rad_s: Tensor
    step_s: Tensor
    friction: Tensor
    contact_time_s: Tensor
    damping_ratio: Tensor
    viscous_n_s_m: Tensor | None = None
    rolling_m: Tensor | None = None
    torsion_m: Tensor | None = None
    anisotropy: Tensor | None = None

    @property
    def approach_m_s(self) -> Tensor:
        """Speed (n, C) at which the gap widens; negative on approach."""
        return (self.velocity * self.normal).sum(-1)

    @property
    def slip_m_s(self) -> Tensor:
        """Velocity (n, C, 3) along the surface."""
        return self.velocity - self.approach_m_s[..., None] * self.normal


def coefficients(contact_time_s: Tensor, damping_ratio: Tensor, step_s: Tensor) -> tuple[Tensor, Tensor]:
    """Return the dimensionless stiffness k and damping d for a step [s]; the shapes broadcast.

    Derived: the discrete map (velocity step, then trapezoidal position step) gets the eigenvalues of the exact
    flow of x'' + 2 zeta/tau x' + x/tau^2 = 0 over one step, so that restitution and contact time do not
    depend on the step: k = 1 + D - T, k + d = (3 - T - D)/2 with T, D trace and determinant of the exact flow.
    """
    eta, zeta = step_s / contact_time_s, damping_ratio
    gap = 1 - zeta.square()
    below = gap > 0
    safe = torch.where(gap.abs() < 1e-12, torch.full_like(gap, 1e-12), gap.abs())
    angle = safe.sqrt() * eta
    trace = 2 * torch.exp(-zeta * eta) * torch.where(below, angle.cos(), angle.cosh())
    determinant = torch.exp(-2 * zeta * eta)
    k = 1 + determinant - trace
    return k, (3 - trace - determinant) / 2 - k


def restitution(damping_ratio: Tensor) -> Tensor:
    """Return the restitution e(zeta) of a resolved impact [1], same shape.

    Derived (contact model notes, section 5.7): a spring-damper that starts at gap 0 and ends when its force is 0.
    """
    zeta = damping_ratio
    gap = 1 - zeta.square()
    root = torch.where(gap.abs() < 1e-9, torch.full_like(gap, 1e-9), gap.abs()).sqrt()
    under = torch.exp(-zeta / root * torch.atan2(2 * zeta * root, 2 * zeta.square() - 1))
    over = torch.exp(-zeta / root * torch.log((zeta + root) / (zeta - root).clamp_min(1e-12)))
    return torch.where(gap > 0, under, over)


def damping_ratio_of(restitution_wanted: Tensor) -> Tensor:
    """Return the damping ratio zeta [1] of restitutions in (0.005, 1), same shape: the inverse of `restitution`.

    By bisection of log zeta, for e(zeta) falls monotonically; accurate to rounding, without derivatives.

    Raises:
        InputDataError: If a restitution lies outside that range.
    """
    wanted = restitution_wanted.detach()
    if not bool(((wanted > 0.005) & (wanted < 1)).all()):
        raise InputDataError(
            f"restitution {wanted.flatten().tolist()}: no damping ratio gives one of its values.",
            "0.005 < restitution < 1.",
            "use 0.99 for a nearly lossless contact, 0.01 for a dead one.",
        )
    low, high = torch.full_like(wanted, math.log(1e-4)), torch.full_like(wanted, math.log(10.0))
    for _ in range(60):
        middle = 0.5 * (low + high)
        bouncy = restitution(middle.exp()) > wanted
        low, high = torch.where(bouncy, middle, low), torch.where(bouncy, high, middle)
    return (0.5 * (low + high)).exp()
