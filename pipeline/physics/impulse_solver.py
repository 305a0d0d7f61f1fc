"""Impulses of contacts that act at once: the closed form of every contact, then projected sweeps over all of them.

One sweep is the closed form alone. Further ones let contacts that touch at once agree: each takes back what it gave,
sees the velocity that all the others leave, and is projected anew on its own admissible set. They begin from the
impulses of the step before, so that over the steps even slow modes of contacts come to rest.

Everything is expressed by mass-weighted Jacobian rows (n, 3 C, nv), |row|^2 = 1/m_eff, of the generalised velocity
of a body: nv = 6 for a free one, rows [d/sqrt(m), (arm x d) S] with inverse inertia S S^T. A chain of links needs only
other rows: those of its generalised velocity times the inverse root of its mass matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from .contact import Touch, coefficients
from .ellipse import TINY, Ellipse
from .rotation import cross

CONTACT_ONSET_M = 2e-4
"""A contact counts fully in the sharing of a body's mass from this depth on [m]; it only smooths the onset."""
FAR_M_S = 1e30
"""An open contact asks for a gap speed below any [m/s]; finite, as the reverse derivative of infinity is no number."""


@dataclass(frozen=True)
class Rows:
    """How impulses at the contact points move one body, and the body's points.

    body: its index in the world; sign: +1 as body a, -1 as body b; jacobian (n, 3 C, 6): rows of each contact along
    its normal and two tangents; root (n, 3, 3): S with inverse inertia = S S^T, world axes.
    """

    body: int
    sign: float
    jacobian: Tensor
    root: Tensor

    @staticmethod
    def of(
        body: int,
        sign: float,
        arms: Tensor,
        axes: Tensor,
        inverse_mass_root: Tensor,
        root: Tensor,
    ) -> Rows:
        """Build the rows of a free body.

        Args:
            body: Its index.
            sign: +1 as body a, -1 as body b.
            arms: From the centre of mass to the points (n, C, 3) [m], world frame.
            axes: Normal and tangents of each point as rows (n, C, 3, 3).
            inverse_mass_root: 1/sqrt(mass), shape (n,).
            root: S (n, 3, 3).
        """
        linear = sign * axes * inverse_mass_root[:, None, None, None]
        turning = sign * cross(arms[:, :, None], axes).flatten(1, 2) @ root
        return Rows(body, sign, torch.cat((linear.flatten(1, 2), turning), -1), root)


def tangent_axes(normal: Tensor) -> Tensor:
    """Return unit normal and two tangents as rows (..., 3, 3), smooth but where the normal turns over its pole.

    Source: Duff et al., "Building an orthonormal basis, revisited" (JCGT 2017).
    """
    x, y, z = normal.unbind(-1)
    sign = torch.where(z >= 0, torch.ones_like(z), -torch.ones_like(z))
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack((1 + sign * x * x * a, sign * b, -sign * x), -1)
    second = torch.stack((b, sign + y * y * a, -y), -1)
    return torch.stack((normal, first, second), -2)


@dataclass(frozen=True)
class ContactGroup:
    """The contacts of one pair of bodies in one step, prepared for the sweeps; n items, C points.

    axes (n, C, 3, 3): normal and tangents as rows; relative (n, C, 3): free velocity of a against b along them;
    sides: the rows of the bodies that can move; target (n, C): the gap speed that each closed contact asks for;
    stop_n, stop_t (n, C) [kg]: what one contact may move at once; steady (n, C, 3) [N s]: impulses that stay as they
    are; where turning is resisted, spin (n, 3) [rad/s]: free angular velocity of a against b, stop_w (n, C, 2) [kg m2]:
    what one contact may stop of it about the normal and across it, torsion_m and rolling_m (n, C). ellipse: in place of
    the friction, where that depends on the direction.
    """

    axes: Tensor
    relative: Tensor
    sides: tuple[Rows, ...]
    target: Tensor
    stop_n: Tensor
    stop_t: Tensor
    friction: Tensor
    steady: Tensor | None = None
    spin: Tensor | None = None
    stop_w: Tensor | None = None
    torsion_m: Tensor | None = None
    rolling_m: Tensor | None = None
    ellipse: Ellipse | None = None

    @staticmethod
    def of(touch: Touch, axes: Tensor, sides: tuple[Rows, ...]) -> ContactGroup:
        """Prepare the contacts of a pair; `axes` have the touch's normals as first rows."""
        h, gap = touch.step_s, touch.gap
        relative = (axes @ touch.velocity[..., None]).squeeze(-1)
        speed = relative[..., 0]
        rows = sides[0].jacobian if len(sides) == 1 else torch.cat([side.jacobian for side in sides], -1)
        mobility = rows.square().sum(-1).unflatten(1, (-1, 3))
        normal_rows = rows.unflatten(1, (-1, 3))[:, :, 0]
        mass = 1 / mobility[..., 0]
        ahead = gap + h * speed
        share = _share(normal_rows, mass, ahead, gap)

        k, d = coefficients(touch.contact_time_s, touch.damping_ratio, h)
        # the fraction of the step that the contact is closed makes the damper's onset continuous in the gap
        closing = (h * speed.abs()).clamp_min(1e-12)
        closed = torch.where(gap > 0, (-ahead / closing).clamp(0.0, 1.0), torch.ones_like(gap))
        demand = -d * closed * speed - k * ahead.clamp_max(0.0) / h
        touching = (gap < 0) | (ahead < 0)
        target = torch.where(touching, speed + demand, torch.full_like(gap, -FAR_M_S))
        # the sum of the two tangential mobilities bounds the larger one
        stop_t = share / (mobility[..., 1] + mobility[..., 2])
        group = ContactGroup(axes, relative, sides, target, share * mass, stop_t, touch.friction)
        if touch.anisotropy is not None:
            group = replace(group, ellipse=Ellipse.of(touch.friction, touch.anisotropy))
        if touch.viscous_n_s_m is not None:
            # implicit in the slip of the point itself, so that no viscosity turns it round
            drag = h * touch.viscous_n_s_m * _shares(ahead, gap)
            slip = torch.cat((torch.zeros_like(relative[..., :1]), relative[..., 1:]), -1)
            group = replace(group, steady=-(drag / (1 + drag / stop_t))[..., None] * slip)
        if touch.torsion_m is not None or touch.rolling_m is not None:
            group = group._resisting(touch, touching)
        return group

    def _resisting(self, touch: Touch, touching: Tensor) -> ContactGroup:
        """Return the group with resistance to turning: all its points act on the same spin, and share it."""
        roots = torch.cat([side.root for side in self.sides], -1)
        mobility = (self.axes.flatten(1, 2) @ roots).square().sum(-1).unflatten(1, (-1, 3))
        count = touching.to(mobility.dtype).sum(1, keepdim=True).clamp_min(1.0)
        stop = torch.stack((mobility[..., 0], mobility[..., 1] + mobility[..., 2]), -1) * count[..., None]
        zero = torch.zeros_like(self.stop_n)
        none = [zero if value is None else value + zero for value in (touch.torsion_m, touch.rolling_m)]
        return replace(self, spin=touch.spin_rad_s, stop_w=1 / stop, torsion_m=none[0], rolling_m=none[1])


@dataclass(frozen=True)
class Impulses:
    """Impulses of a group on body a, along its axes (n, C, 3) [N s], and angular ones (n, C, 3) [N m s]."""

    linear: Tensor
    angular: Tensor | None = None


def settle(groups: Sequence[ContactGroup], sweeps: int, warm: Sequence[Tensor | None]) -> list[Impulses]:
    """Return the impulses of all groups after the given number of sweeps; one from nothing is the closed form.

    Args:
        groups: The contacts of a step.
        sweeps: How often every contact is projected anew.
        warm: Impulses (n, C, 3) [N s] along the axes from which each group begins, None for nothing: those of the step
            before, so that what a few sweeps leave of slow modes is made up for in the following steps.
    """
    groups = _splitting(groups)
    found = [
        Impulses(torch.zeros_like(group.relative) if old is None else old)
        for group, old in zip(groups, warm, strict=True)
    ]
    for _ in range(sweeps):
        seen = _all_seen(groups, found)
        found = [_sweep(group, given, *now) for group, given, now in zip(groups, found, seen, strict=True)]
    return found


def _splitting(groups: Sequence[ContactGroup]) -> Sequence[ContactGroup]:
    """Return the groups, each to move its share of a body that others touch too, or the sweeps would overshoot."""
    if len(groups) < 2:
        return groups
    count: dict[int, Tensor] = {}
    for group in groups:
        active = (group.target > -0.5 * FAR_M_S).any(1, keepdim=True).to(group.target.dtype)
        for side in group.sides:
            count[side.body] = active if side.body not in count else count[side.body] + active
    split = []
    for group in groups:
        share = 1 / torch.stack([count[side.body] for side in group.sides]).amax(0).clamp_min(1.0)
        wide = None if group.stop_w is None else share[..., None] * group.stop_w
        split.append(replace(group, stop_n=share * group.stop_n, stop_t=share * group.stop_t, stop_w=wide))
    return split


def _all_seen(groups: Sequence[ContactGroup], impulses: Sequence[Impulses]) -> list[tuple[Tensor, Tensor | None]]:
    """Return for each group the velocities of its points (n, C, 3) and its spin (n, 3) under all impulses."""
    moved: dict[int, Tensor] = {}
    for group, given in zip(groups, impulses, strict=True):
        for side in group.sides:
            motion = _motion(side, group, given)
            moved[side.body] = motion if side.body not in moved else moved[side.body] + motion
    return [_seen(group, moved) for group in groups]


def _motion(side: Rows, group: ContactGroup, impulses: Impulses) -> Tensor:
    """Return the change (n, nv, 1) of a body's mass-weighted velocity."""
    motion = side.jacobian.transpose(1, 2) @ impulses.linear.flatten(1)[..., None]
    if impulses.angular is None:
        return motion
    torque = (impulses.angular[..., None, :] @ group.axes).squeeze(-2).sum(1)
    turning = side.sign * side.root.transpose(1, 2) @ torque[..., None]
    return motion + torch.cat((torch.zeros_like(turning), turning), 1)


def _seen(group: ContactGroup, moved: dict[int, Tensor]) -> tuple[Tensor, Tensor | None]:
    """Return the velocity of the points and the relative spin under the impulses of all groups."""
    relative, omega = group.relative, group.spin
    for side in group.sides:
        change = moved[side.body]
        relative = relative + (side.jacobian @ change).squeeze(-1).unflatten(1, (-1, 3))
        if omega is not None:
            omega = omega + side.sign * (side.root @ change[:, 3:]).squeeze(-1)
    return relative, omega


def _sweep(group: ContactGroup, before: Impulses, relative: Tensor, omega: Tensor | None) -> Impulses:
    """Return the impulses after one projected sweep from those before, under the velocities (n, C, 3) they leave."""
    steady = group.steady
    linear = before.linear if steady is None else before.linear - steady
    along = linear[..., 0] + group.stop_n * (group.target - relative[..., 0])
    wanted = linear[..., 1:] - group.stop_t[..., None] * relative[..., 1:]
    along = along.clamp_min(0.0)
    if group.ellipse is None:
        across = in_disc(wanted, group.friction * along)
    else:
        across = group.ellipse.nearest(wanted, along)
    linear = torch.cat((along[..., None], across), -1)
    if steady is not None:
        linear = linear + steady
    if omega is None:
        return Impulses(linear)
    assert group.stop_w is not None and group.torsion_m is not None and group.rolling_m is not None
    turning = (group.axes @ omega[:, None, :, None]).squeeze(-1)
    wanted = -torch.cat((group.stop_w[..., :1], group.stop_w[..., 1:].expand(-1, -1, 2)), -1) * turning
    if before.angular is not None:
        wanted = before.angular + wanted
    torsion = in_disc(wanted[..., :1], group.torsion_m * along)
    rolling = in_disc(wanted[..., 1:], group.rolling_m * along)
    return Impulses(linear, torch.cat((torsion, rolling), -1))


def in_disc(wanted: Tensor, limit: Tensor) -> Tensor:
    """Return vectors (..., d) shortened to at most `limit` (...)."""
    size = (wanted.square().sum(-1) + TINY).sqrt()
    return (limit / size).clamp_max(1.0)[..., None] * wanted


def _share(rows: Tensor, mass: Tensor, ahead: Tensor, gap: Tensor) -> Tensor:
    """Return the share of its work that each contact does itself (n, C): 1 alone, 1/n for n coincident ones.

    Derived: its weight over the sum of the touching contacts' weights times the squared correlations of their rows with
    its own in the mass metric, in O(C) through the small matrix sum of m r r^T. Only ratios of weights count: contacts
    that all touch lightly share like contacts that all touch hard, or the sweeps would overshoot.
    """
    weight = _onset(ahead, gap)
    weighted = rows * (weight * mass)[..., None]
    gram = weighted.transpose(-1, -2) @ rows
    total = mass * ((rows @ gram) * rows).sum(-1)
    return (weight + 1e-9) / (torch.maximum(total, weight) + 1e-9)


def _onset(ahead: Tensor, gap: Tensor) -> Tensor:
    """Return how far each contact counts (n, C), from 0 where it is open to 1 where it is deep."""
    return (-torch.minimum(ahead, gap) / CONTACT_ONSET_M).clamp(0.0, 1.0)


def _shares(ahead: Tensor, gap: Tensor) -> Tensor:
    """Return the shares (n, C) of what all the contacts of a pair carry together; they add up to 1.

    Only within the first 2 % of the onset is it less, so that a grazing contact begins without a jump.
    """
    touching = _onset(ahead, gap)
    return touching / touching.sum(1, keepdim=True).clamp_min(0.02)
