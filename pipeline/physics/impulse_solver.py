"""Impulses of simultaneous contacts: the closed form of every contact, then projected iterations over all of them.

One iteration is the closed form alone. Further ones (projected Jacobi iterations with shared masses) couple contacts
that act at once: each contact is projected anew on its own admissible set, given the velocity under the impulses of all
others. They are warm-started with the impulses of the previous step, so that slow modes converge over several steps.

Everything is expressed by mass-weighted Jacobian rows (n, 3 C, nv), |row|^2 = 1/m_eff, of the generalised velocity
of a body: nv = 6 for a free one, rows [d/sqrt(m), (arm x d) S] with inverse inertia S S^T. For a chain of links only
the rows differ: those of its generalised velocity times the inverse root of its mass matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..geometry.rotation import cross
from .contact_law import Touch, coefficients
from .friction_ellipse import TINY, Ellipse

if TYPE_CHECKING:
    from .chains.joint_rows import JointRows

CONTACT_ONSET_M = 2e-4
"""Depth [m] from which a contact takes its full share of a body's mass; below, the share grows smoothly."""
LEAST_MOBILITY = 1e-18
"""Added to a sum of mobilities [1/kg], so that it may be divided by where nothing touches."""
IMMOVABLE = 1e-11
"""Mobility along the normal [1/kg] up to which a contact moves nothing, as between what is driven and a link whose
joints do not let it yield: it does not act."""
LEAST_ACROSS = 1e-6
"""Least mobility across the normal, as a share of that along it: a drawer yields along its rail alone."""
FAR_M_S = 1e30
"""Target gap speed of an open contact [m/s], below any real one; finite, so that reverse derivatives stay finite."""


@dataclass(frozen=True)
class Rows:
    """Jacobian rows that map impulses at the contact points to the velocity of one body."""

    body: int
    """Index of the body in the world."""
    sign: float
    """+1 as body a, -1 as body b."""
    jacobian: Tensor
    """Mass-weighted rows of each contact along its normal and two tangents, shape (n, 3 C, 6)."""
    root: Tensor
    """Matrix S with inverse inertia = S S^T, world axes, shape (n, 3, 3); of a link the rows (n, 3, nv) of its angular
    velocity.
    """
    linked: bool = False
    """Whether the body is a link of a chain, and `body` the root of the chain."""
    branch: int | None = None
    """Index of the body that stands for all on which its impulses act at once: of a link the first of its branch that
    moves; None for `body`.
    """

    @property
    def shared(self) -> int:
        """Index of the body among whose contacts the mass is divided."""
        return self.body if self.branch is None else self.branch

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

    def turned(self, torque: Tensor) -> Tensor:
        """Return the change (n, nv, 1) of the mass-weighted velocity by an angular impulse (n, 3) on body a."""
        turning = self.sign * self.root.transpose(1, 2) @ torque[..., None]
        return turning if self.linked else torch.cat((torch.zeros_like(turning), turning), 1)

    def spin(self, change: Tensor) -> Tensor:
        """Return the relative angular velocity (n, 3) that a change (n, nv, 1) makes."""
        return self.sign * (self.root @ (change if self.linked else change[:, 3:])).squeeze(-1)


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
class TurningResistance:
    """Resistance of the contacts of one pair to rolling and to spinning about the normal; n items, C points."""

    spin: Tensor
    """Free angular velocity of a against b, world frame [rad/s], shape (n, 3)."""
    stop: Tensor
    """Angular mass that one contact may stop about the normal and across it [kg m2], shape (n, C, 2)."""
    torsion_m: Tensor
    """Largest torque about the normal in units of the normal force [m], shape (n, C)."""
    rolling_m: Tensor
    """Largest torque across the normal in units of the normal force [m], shape (n, C)."""


@dataclass(frozen=True)
class Response:
    """What contacts ask for; n items, C points."""

    gap: Tensor
    """Gap [m], shape (n, C)."""
    step_s: Tensor
    """Step [s], shape (n, 1)."""
    stiffness: Tensor
    """Dimensionless stiffness of a step [1], shape (n, 1 or C)."""
    damping: Tensor
    """Dimensionless damping of a step [1], shape (n, 1 or C)."""

    def aim(self, speed: Tensor) -> Tensor:
        """Return the gap speed (n, C) [m/s] that the contacts ask for, given that without them (n, C) [m/s]."""
        gap, h = self.gap, self.step_s
        ahead = gap + h * speed
        # the fraction of the step that the contact is closed makes the damper's onset continuous in the gap
        closing = (h * speed.abs()).clamp_min(1e-12)
        closed = torch.where(gap > 0, (-ahead / closing).clamp(0.0, 1.0), torch.ones_like(gap))
        return speed - self.damping * closed * speed - self.stiffness * ahead.clamp_max(0.0) / h


@dataclass(frozen=True, kw_only=True)
class ContactGroup:
    """Contacts of one pair of bodies in one step, prepared for the solver; n items, C points."""

    axes: Tensor
    """Normal and tangents of each point as rows, shape (n, C, 3, 3)."""
    relative: Tensor
    """Free velocity of a against b along the axes [m/s], shape (n, C, 3)."""
    sides: tuple[Rows, ...]
    """Jacobian rows of the bodies that can move."""
    response: Response
    """What the contacts ask for."""
    target: Tensor
    """Gap speed that each closed contact asks for [m/s], shape (n, C)."""
    stop_n: Tensor
    """Mass that one contact may move along its normal [kg], shape (n, C)."""
    stop_t: Tensor
    """Mass that one contact may move along its tangents [kg], shape (n, C)."""
    friction: Tensor
    """Friction coefficient [1], shape (n, 1 or C)."""
    steady: Tensor | None = None
    """Impulses that the iterations do not change [N s], shape (n, C, 3); None for none."""
    turning: TurningResistance | None = None
    """Resistance to rolling and spinning; None for none."""
    ellipse: Ellipse | None = None
    """Anisotropic friction, which replaces `friction`; None for isotropic friction."""

    @staticmethod
    def of(touch: Touch, axes: Tensor, sides: tuple[Rows, ...]) -> ContactGroup:
        """Prepare the contacts of a pair; the first rows of `axes` are the normals of the touch."""
        h, gap = touch.step_s, touch.gap
        relative = (axes @ touch.velocity[..., None]).squeeze(-1)
        speed = relative[..., 0]
        rows = sides[0].jacobian if len(sides) == 1 else torch.cat([side.jacobian for side in sides], -1)
        mobility = rows.square().sum(-1).unflatten(1, (-1, 3))
        normal_rows = rows.unflatten(1, (-1, 3))[:, :, 0]
        along, across = mobility[..., 0], mobility[..., 1] + mobility[..., 2]
        moves = along > IMMOVABLE
        along = torch.where(moves, along, 1.0)
        mass = 1 / along
        ahead = gap + h * speed
        weight = _onset(ahead, gap) * moves
        if touch.area is None:
            share = _share(normal_rows, mass, weight)
        else:
            weight = touch.area * weight
            share = _share_by_area(normal_rows, mass, weight)

        k, d = coefficients(touch.contact_time_s, touch.damping_ratio, h)
        response = Response(gap, h, k, d)
        touching = ((gap < 0) | (ahead < 0)) & moves
        target = torch.where(touching, response.aim(speed), torch.full_like(gap, -FAR_M_S))
        # the sum of the two tangential mobilities bounds the larger one
        stop_t = share / torch.maximum(across, LEAST_ACROSS * along)
        group = ContactGroup(
            axes=axes,
            relative=relative,
            sides=sides,
            response=response,
            target=target,
            stop_n=share * mass,
            stop_t=stop_t,
            friction=touch.friction,
        )
        if touch.anisotropy is not None:
            group = replace(group, ellipse=Ellipse.of(touch.friction, touch.anisotropy))
        if touch.viscous_n_s_m is not None:
            # implicit in the slip of the point itself, so that no viscosity reverses it
            drag = h * touch.viscous_n_s_m * _shares(weight)
            slip = torch.cat((torch.zeros_like(relative[..., :1]), relative[..., 1:]), -1)
            group = replace(group, steady=-(drag / (1 + drag / stop_t))[..., None] * slip)
        if touch.torsion_m is not None or touch.rolling_m is not None:
            group = replace(group, turning=group._resistance(touch, touching))
        return group

    def _resistance(self, touch: Touch, touching: Tensor) -> TurningResistance:
        """Return the resistance to turning: all points of the group act on the same spin, and share it."""
        roots = torch.cat([side.root for side in self.sides], -1)
        mobility = (self.axes.flatten(1, 2) @ roots).square().sum(-1).unflatten(1, (-1, 3))
        count = touching.to(mobility.dtype).sum(1, keepdim=True).clamp_min(1.0)
        stop = torch.stack((mobility[..., 0], mobility[..., 1] + mobility[..., 2]), -1) * count[..., None]
        zero = torch.zeros_like(self.stop_n)
        torsion, rolling = (zero if value is None else value + zero for value in (touch.torsion_m, touch.rolling_m))
        return TurningResistance(touch.spin_rad_s, 1 / stop, torsion, rolling)


@dataclass(frozen=True)
class Impulses:
    """Impulses of a group on body a."""

    linear: Tensor
    """Impulses along the axes [N s], shape (n, C, 3)."""
    angular: Tensor | None = None
    """Angular impulses along the axes [N m s], shape (n, C, 3); None for none."""


def solve_impulses(groups: Sequence[ContactGroup], iterations: int, warm: Sequence[Tensor | None]) -> list[Impulses]:
    """Solve the impulses of all groups by projected iterations; one iteration without warm start is the closed form.

    Args:
        groups: The contacts of a step.
        iterations: Number of iterations.
        warm: Initial impulses (n, C, 3) [N s] along the axes of each group, None for zero: those of the previous step,
            so that slow modes that few iterations do not resolve converge over the following steps.
    """
    return solve_with_joints(groups, iterations, warm, (), ())[0]


def solve_with_joints(
    groups: Sequence[ContactGroup],
    iterations: int,
    warm: Sequence[Tensor | None],
    joints: Sequence[JointRows],
    joint_warm: Sequence[Tensor | None],
    under_load: bool = True,
) -> tuple[list[Impulses], list[Tensor]]:
    """Solve the impulses of all groups, and those (n, J, 3) of the joints of chains after each iteration over them.

    Contacts carry the load of others where `under_load`; the kernel does not in worlds with chains.
    """
    groups = _splitting(groups)
    rubbed = [
        torch.zeros_like(rows.target[..., :1].expand(-1, -1, 3)) if old is None else old
        for rows, old in zip(joints, joint_warm, strict=True)
    ]
    found = [
        Impulses(torch.zeros_like(group.relative) if old is None else old)
        for group, old in zip(groups, warm, strict=True)
    ]
    loaded = _loaded(groups) if under_load else None
    for _ in range(iterations):
        velocities = _all_velocities(groups, found, joints, rubbed)
        if loaded is not None:
            groups = [_under_load(*each, loaded) for each in zip(groups, found, velocities, strict=True)]
        found = [_iterate(group, given, *now) for group, given, now in zip(groups, found, velocities, strict=True)]
        if joints:
            moved = _moved(groups, found, joints, rubbed)
            rubbed = [rows.solve(old, moved[rows.body])[0] for rows, old in zip(joints, rubbed, strict=True)]
    return found, rubbed


def _splitting(groups: Sequence[ContactGroup]) -> Sequence[ContactGroup]:
    """Divide the mass of a body, or a branch of a chain, among what touches it, so that iterations do not overshoot."""
    if len(groups) < 2:
        return groups
    count: dict[int, Tensor] = {}
    for group in groups:
        active = (group.target > -0.5 * FAR_M_S).any(1, keepdim=True).to(group.target.dtype)
        for side in group.sides:
            count[side.shared] = active if side.shared not in count else count[side.shared] + active
    split = []
    for group in groups:
        share = 1 / torch.stack([count[side.shared] for side in group.sides]).amax(0).clamp_min(1.0)
        turning = group.turning
        if turning is not None:
            turning = replace(turning, stop=share[..., None] * turning.stop)
        split.append(replace(group, stop_n=share * group.stop_n, stop_t=share * group.stop_t, turning=turning))
    return split


def _loaded(groups: Sequence[ContactGroup]) -> Tensor | None:
    """Return in which items (n, 1) several pairs of bodies touch; None where there is one pair."""
    if len(groups) < 2:
        return None
    active = [(group.target > -0.5 * FAR_M_S).any(1, keepdim=True) for group in groups]
    return torch.stack(active).sum(0) > 1


def _under_load(
    group: ContactGroup, impulses: Impulses, now: tuple[Tensor, Tensor | None], loaded: Tensor
) -> ContactGroup:
    """Aim the contacts of a pair at what they ask for under the present impulses of all other pairs.

    A contact so carries the load that others put on its bodies, and not only their weight: under their weight alone,
    two bodies in free fall ask for no force between them, and a stack would open and close at every step.
    """
    speed = now[0][..., 0]
    for side in group.sides:
        own = (side.jacobian @ _motion(side, group, impulses)).squeeze(-1)
        speed = speed - own.unflatten(1, (-1, 3))[..., 0]
    active = loaded & (group.target > -0.5 * FAR_M_S)
    return replace(group, target=torch.where(active, group.response.aim(speed), group.target))


def _all_velocities(
    groups: Sequence[ContactGroup],
    impulses: Sequence[Impulses],
    joints: Sequence[JointRows] = (),
    rubbed: Sequence[Tensor] = (),
) -> list[tuple[Tensor, Tensor | None]]:
    """Return for each group the velocities of its points (n, C, 3) and its spin (n, 3) under all impulses."""
    moved = _moved(groups, impulses, joints, rubbed)
    return [_velocities(group, moved) for group in groups]


def _moved(
    groups: Sequence[ContactGroup],
    impulses: Sequence[Impulses],
    joints: Sequence[JointRows],
    rubbed: Sequence[Tensor],
) -> dict[int, Tensor]:
    """Return the change (n, nv, 1) of the mass-weighted velocity of each body, and of each chain under its root."""
    moved = {rows.body: rows.motion(given) for rows, given in zip(joints, rubbed, strict=True)}
    for group, given in zip(groups, impulses, strict=True):
        for side in group.sides:
            motion = _motion(side, group, given)
            moved[side.body] = motion if side.body not in moved else moved[side.body] + motion
    return moved


def _motion(side: Rows, group: ContactGroup, impulses: Impulses) -> Tensor:
    """Return the change (n, nv, 1) of a body's mass-weighted velocity."""
    motion = side.jacobian.transpose(1, 2) @ impulses.linear.flatten(1)[..., None]
    if impulses.angular is None:
        return motion
    torque = (impulses.angular[..., None, :] @ group.axes).squeeze(-2).sum(1)
    return motion + side.turned(torque)


def _velocities(group: ContactGroup, moved: dict[int, Tensor]) -> tuple[Tensor, Tensor | None]:
    """Return the velocity of the points and the relative spin under the impulses of all groups."""
    relative, omega = group.relative, None if group.turning is None else group.turning.spin
    for side in group.sides:
        change = moved[side.body]
        relative = relative + (side.jacobian @ change).squeeze(-1).unflatten(1, (-1, 3))
        if omega is not None:
            omega = omega + side.spin(change)
    return relative, omega


def _iterate(group: ContactGroup, before: Impulses, relative: Tensor, omega: Tensor | None) -> Impulses:
    """Return the impulses after one projected iteration, given the velocities (n, C, 3) under the previous ones."""
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
    resistance = group.turning
    if omega is None or resistance is None:
        return Impulses(linear)
    turning = (group.axes @ omega[:, None, :, None]).squeeze(-1)
    wanted = -torch.cat((resistance.stop[..., :1], resistance.stop[..., 1:].expand(-1, -1, 2)), -1) * turning
    if before.angular is not None:
        wanted = before.angular + wanted
    torsion = in_disc(wanted[..., :1], resistance.torsion_m * along)
    rolling = in_disc(wanted[..., 1:], resistance.rolling_m * along)
    return Impulses(linear, torch.cat((torsion, rolling), -1))


def in_disc(wanted: Tensor, limit: Tensor) -> Tensor:
    """Return vectors (..., d) shortened to at most `limit` (...)."""
    size = (wanted.square().sum(-1) + TINY).sqrt()
    return (limit / size).clamp_max(1.0)[..., None] * wanted


def _share(rows: Tensor, mass: Tensor, weight: Tensor) -> Tensor:
    """Return the share of the mass for each contact (n, C): 1 for a single contact, 1/n for n coincident ones.

    Derived: its weight over the sum of the touching contacts' weights times the squared correlations of their rows with
    its own in the mass metric, in O(C) through the small matrix sum of m r r^T. Only ratios of weights count: contacts
    that all touch lightly share like contacts that all touch hard; otherwise the iterations would overshoot.
    """
    weighted = rows * (weight * mass)[..., None]
    gram = weighted.transpose(-1, -2) @ rows
    total = mass * ((rows @ gram) * rows).sum(-1)
    return (weight + 1e-9) / (torch.maximum(total, weight) + 1e-9)


def _share_by_area(rows: Tensor, mass: Tensor, weight: Tensor) -> Tensor:
    """Return the share of the mass for each contact (n, C) of a patch, whose stiffness is proportional to its weight.

    Derived: with A = sum of w r r^T over the mass-weighted rows r, the common factor tr(A) / tr(A^2) makes the largest
    eigenvalue of its multiple at most 1.37 (1 for the patch of a thin plate), so that the iterations converge. For
    points in like places, such as the corners of a square, it is the same as `_share`.
    """
    gram = (rows * weight[..., None]).transpose(-1, -2) @ rows
    spread = ((rows @ gram) * rows).sum(-1)
    bound = (weight * spread).sum(1, keepdim=True) / ((weight / mass).sum(1, keepdim=True) + LEAST_MOBILITY)
    return (weight + 1e-9) / (torch.maximum(mass * bound, weight) + 1e-9)


def _onset(ahead: Tensor, gap: Tensor) -> Tensor:
    """Return the weight of each contact (n, C), from 0 where it is open to 1 from the depth CONTACT_ONSET_M on."""
    return (-torch.minimum(ahead, gap) / CONTACT_ONSET_M).clamp(0.0, 1.0)


def _shares(weight: Tensor) -> Tensor:
    """Return the shares (n, C) of the contacts of a pair in a common load, given their weights; they sum to 1.

    Within the first 2 % of the onset the sum is less, so that a grazing contact begins without a jump.
    """
    return weight / weight.sum(1, keepdim=True).clamp_min(0.02)
