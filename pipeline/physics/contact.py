"""The closed-form, complementarity-free contact law.

Source: the row rule of complementarity-free contact (arXiv 2408.07855) in its mass- and count-normalised form
(contact model notes, section 6; derived): for contact c with effective mass m_c and weight q_c,

    impulse_n = m_c q_c max(0, -(k + d) u_n - k gap / h)

u_n is the free velocity of the gap, h the step. tau and zeta are the contact's natural time and damping ratio, so the
material depends neither on mass, nor on the step, nor on how many spheres touch. Friction is applied to the
tangential velocity separately, inside the disc of radius friction * impulse_n, which avoids the lift and the
anisotropy of polyhedral rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from .rotation import cross

CONTACT_ONSET_M = 2e-4
"""A contact counts fully in the sharing of a body's mass from this depth on [m]; it only smooths the onset."""


@dataclass(frozen=True)
class ContactLaw:
    """The numbers of a contact, each of shape (1,) or (B,)."""

    friction: Tensor
    contact_time_s: Tensor
    damping_ratio: Tensor

    def coefficients(self, step_s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the dimensionless stiffness k and damping d (B,) for a step [s] of shape (B,).

        Derived: the discrete map (velocity step, then trapezoidal position step) gets the eigenvalues of the exact
        flow of x'' + 2 zeta/tau x' + x/tau^2 = 0 over one step, so that restitution and contact time do not
        depend on the step: k = 1 + D - T, k + d = (3 - T - D)/2 with T, D trace and determinant of the exact flow.
        """
        eta, zeta = step_s / self.contact_time_s, self.damping_ratio
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


@dataclass(frozen=True)
class Side:
    """One of the two bodies of a contact group; all vectors in the world frame.

    velocity (B, 3) [m/s] of the centre of mass; omega (B, 3) [rad/s]; inverse_mass (B,) [1/kg];
    inverse_inertia_root (B, 3, 3): S with inverse inertia = S S^T; arms (B, C, 3) [m] from the centre of mass to the
    contact points. A driven or fixed body has inverse mass and inertia 0.
    """

    velocity: Tensor
    omega: Tensor
    inverse_mass: Tensor
    inverse_inertia_root: Tensor
    arms: Tensor

    def moving(self, velocity: Tensor, spin: Tensor) -> Side:
        """Return the side with another velocity (B, 3) and, of a free body, angular momentum (B, 3) [kg m2/s].

        A driven body keeps its motion.
        """
        if not bool(self.inverse_mass.any()):
            return self
        root = self.inverse_inertia_root
        return replace(self, velocity=velocity, omega=((spin[:, None] @ root) @ root.transpose(-1, -2)).squeeze(1))

    def point_velocity(self) -> Tensor:
        """Return the velocity of the contact points (B, C, 3) [m/s]."""
        return self.velocity[:, None] + cross(self.omega[:, None], self.arms)

    def row(self, direction: Tensor) -> Tensor:
        """Return the mass-weighted Jacobian rows (B, C, 6) of unit directions (B, C, 3): |row|^2 = 1/m_eff."""
        linear = direction * self.inverse_mass.sqrt()[:, None, None]
        return torch.cat((linear, cross(self.arms, direction) @ self.inverse_inertia_root), -1)

    def mobility_trace(self) -> Tensor:
        """Return the trace (B, C) [1/kg] of the contact points' inverse mass matrices."""
        # sum over axes e of |S^T (arm x e)|^2 = sum over columns s of S of |s|^2 |arm|^2 - (arm . s)^2
        columns = self.inverse_inertia_root
        along = (self.arms @ columns).square().sum(-1)
        across = columns.square().sum((-2, -1))[:, None] * self.arms.square().sum(-1)
        return 3 * self.inverse_mass[:, None] + across - along


@dataclass(frozen=True)
class ContactGroup:
    """The contacts between body a and body b (None: the ground) in one step, prepared for the sweeps.

    normal (B, C, 3), from b to a; target (B, C) [m/s]: the gap speed that each closed contact asks for; stop_n, stop_t
    (B, C) [kg]: the share of its effective mass that one contact moves at once; friction (B,).
    """

    normal: Tensor
    target: Tensor
    stop_n: Tensor
    stop_t: Tensor
    friction: Tensor

    @staticmethod
    def of(
        law: ContactLaw, gap: Tensor, normal: Tensor, a: Side, b: Side | None, step_s: Tensor
    ) -> tuple[ContactGroup, Tensor]:
        """Prepare a group, and return with it the impulses of the closed form.

        Args:
            law: The contact's numbers.
            gap: Signed distance [m], shape (B, C), negative where they overlap.
            normal: Unit normal, world frame, shape (B, C, 3), from b to a.
            a: The body that receives the impulses, with its free velocity.
            b: The body that receives their opposites.
            step_s: Step [s], shape (B,).

        Returns:
            The group, and impulses on a [N s], world frame, shape (B, C, 3).
        """
        h = step_s[:, None]
        relative = a.point_velocity() if b is None else a.point_velocity() - b.point_velocity()
        rows = a.row(normal) if b is None else torch.cat((a.row(normal), -b.row(normal)), -1)
        mobility = a.mobility_trace() if b is None else a.mobility_trace() + b.mobility_trace()
        inverse_mass = rows.square().sum(-1)
        mass = 1 / inverse_mass
        speed = (relative * normal).sum(-1)
        ahead = gap + h * speed
        share = 1 / _crowding(rows, mass, ahead, gap)

        k, d = law.coefficients(step_s)
        # the fraction of the step that the contact is closed makes the damper's onset continuous in the gap
        closing = (h * speed.abs()).clamp_min(1e-12)
        closed = torch.where(gap > 0, (-ahead / closing).clamp(0.0, 1.0), torch.ones_like(gap))
        demand = -d[:, None] * closed * speed - k[:, None] * ahead.clamp_max(0.0) / h
        touching = (gap < 0) | (ahead < 0)
        target = torch.where(touching, speed + demand, torch.full_like(gap, -torch.inf))
        # the two tangential mobilities share the trace less the normal one: their sum bounds the larger one
        group = ContactGroup(normal, target, share * mass, share / (mobility - inverse_mass), law.friction)
        return group, group.sweep(torch.zeros_like(normal), relative)

    def sweep(self, impulse: Tensor, relative: Tensor) -> Tensor:
        """Return the impulses (B, C, 3) [N s] after one projected sweep.

        Args:
            impulse: The impulses so far (B, C, 3) [N s].
            relative: The contact points' relative velocity (B, C, 3) [m/s] under them.
        """
        speed = (relative * self.normal).sum(-1)
        so_far = (impulse * self.normal).sum(-1)
        along = (so_far + self.stop_n * (self.target - speed)).clamp_min(0.0)
        tangential = impulse - so_far[..., None] * self.normal
        slip = relative - speed[..., None] * self.normal
        wanted = tangential - self.stop_t[..., None] * slip
        limit = self.friction[:, None] * along
        # the projection on the disc; the tiny number keeps the derivative of a contact without impulses finite
        size = (wanted.square().sum(-1) + 1e-24).sqrt()
        scale = (limit / size).clamp_max(1.0)
        return along[..., None] * self.normal + scale[..., None] * wanted


def _crowding(rows: Tensor, mass: Tensor, ahead: Tensor, gap: Tensor) -> Tensor:
    """Return how many contacts do the work of each one (B, C): 1 alone, n for n coincident ones.

    Derived: 1 + sum over the other touching contacts of the squared correlation of their rows in the mass metric, in
    O(C) through the small matrix sum of m r r^T.
    """
    depth = -torch.minimum(ahead, gap)
    touching = (depth / CONTACT_ONSET_M).clamp(0.0, 1.0)
    weighted = rows * (touching * mass)[..., None]
    gram = weighted.transpose(-1, -2) @ rows
    total = mass * ((rows @ gram) * rows).sum(-1)
    return 1 + (total - touching).clamp_min(0.0)
