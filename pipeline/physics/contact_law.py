"""Closed-form, complementarity-free contact law: its coefficients, and the contact points to which it applies.

Source: the row rule of complementarity-free contact (arXiv 2408.07855) in its mass- and count-normalised form
(contact model notes, section 6; derived): for contact c with effective mass m_c and weight q_c,

    impulse_n = m_c q_c max(0, -(k + d) u_n - k gap / h)

u_n is the free velocity of the gap, h the step. tau and zeta are the contact's natural time and damping ratio, so the
material depends neither on mass, nor on the step, nor on how many spheres touch. Friction is applied to the
tangential velocity separately, inside the disc of radius friction * impulse_n, which avoids the lift and the
anisotropy of polyhedral rows. `impulse_solver.py` applies the law; `paper_law.py` has the paper's polyhedral form.
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
    """Coefficients of the closed-form contact law, each of shape (1,) or (B,)."""

    name: ClassVar[str] = "closed_form"
    friction: Tensor
    """Coulomb friction coefficient [1]."""
    contact_time_s: Tensor
    """Natural time of a contact [s]."""
    damping_ratio: Tensor
    """Damping ratio of a contact [1]."""


@dataclass(frozen=True)
class Touch:
    """Contact points of two bodies in a step and their coefficients, which effects may change.

    n items of the batch, C points each; coefficients have shape (n, 1) or (n, C).
    """

    ground: bool
    """Whether body b is the ground."""
    position: Tensor
    """Contact points, world frame [m], shape (n, C, 3)."""
    normal: Tensor
    """Unit normals from b to a, world frame, shape (n, C, 3)."""
    gap: Tensor
    """Gap [m], negative where the bodies overlap, shape (n, C)."""
    velocity: Tensor
    """Velocity of a's point relative to b's without contact, world frame [m/s], shape (n, C, 3)."""
    spin_rad_s: Tensor
    """Angular velocity of a relative to b, world frame [rad/s], shape (n, 3)."""
    step_s: Tensor
    """Time step [s], shape (n, 1)."""
    friction: Tensor
    """Coulomb friction coefficient [1]."""
    contact_time_s: Tensor
    """Natural time of the contact [s]."""
    damping_ratio: Tensor
    """Damping ratio of the contact [1]."""
    viscous_n_s_m: Tensor | None = None
    """Viscous force against the slip, shared among the touching points [N s/m]; None for none."""
    rolling_m: Tensor | None = None
    """Largest torque against rolling in units of the normal force [m]; None for none."""
    torsion_m: Tensor | None = None
    """Largest torque against spinning about the normal in units of the normal force [m]; None for none."""
    area: Tensor | None = None
    """Area by which each point takes its share of the load, in any unit, shape (n, C); None where all count alike."""
    anisotropy: Tensor | None = None
    """Coefficients a and b of anisotropic friction along `tangent_axes` of the normal [1], see `friction_ellipse.py`;
    shape (n, 1 or C, 2); None for isotropic friction.
    """

    @property
    def approach_m_s(self) -> Tensor:
        """Speed (n, C) [m/s] at which the gap widens; negative on approach."""
        return (self.velocity * self.normal).sum(-1)

    @property
    def slip_m_s(self) -> Tensor:
        """Slip velocity (n, C, 3) [m/s] along the surface, world frame."""
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
    angle, decay = safe.sqrt() * eta, torch.exp(-zeta * eta)
    trace = 2 * decay * _swing(angle, below)
    determinant = decay.square()
    k = 1 + determinant - trace
    return k, (3 - trace - determinant) / 2 - k


def _swing(angle: Tensor, below: Tensor) -> Tensor:
    """Return the cosine of angles of damping below 1, the hyperbolic cosine of others."""
    if below.numel() == 1 and not below.is_cuda:  # one law for all: half of the work
        return angle.cos() if bool(below) else angle.cosh()
    return torch.where(below, angle.cos(), angle.cosh())


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
            "use 0.99 for a nearly lossless contact, 0.01 for one that does not rebound.",
        )
    low, high = torch.full_like(wanted, math.log(1e-4)), torch.full_like(wanted, math.log(10.0))
    for _ in range(60):
        middle = 0.5 * (low + high)
        bouncy = restitution(middle.exp()) > wanted
        low, high = torch.where(bouncy, middle, low), torch.where(bouncy, high, middle)
    return (0.5 * (low + high)).exp()
