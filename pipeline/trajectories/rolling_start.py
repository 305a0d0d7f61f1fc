"""Spins that nobody measured of balls that begin in contact: they roll, as far as the friction lets them.

A ball that was let go, or pushed, and has been in contact since rolls without slip a few hundredths of a second later:
friction stops a slip of 0.1 m/s in 0.1 / 3.5 mu g. On a slope that is too steep for the friction it keeps slipping, and
its spin and its velocity, which grow at constant rates, keep the ratio that they have when it starts from rest.

Derived. Per mass, gravity pulls along the surfaces by t, its other part is carried by normal forces n_k, and friction
is at most F = mu sum n_k. With the gyration c = I / m and the radius R = |v| / |omega| of rolling (in a groove smaller
than that of the ball), rolling needs the friction t c / (c + R^2). With less the ball gains t - F of velocity and
F R / c of spin in a second, so that omega is F R^2 / (c (t - F)) times that of rolling.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ..geometry.rotation import quat_to_matrix
from ..physics.body import Body
from ..physics.contact_detection import Placed
from ..physics.contact_law import ContactLaw
from ..physics.surfaces.detection import points_within
from ..physics.world import World
from .observations import Observations

NEAR_M = 0.004
"""Gap [m] up to which a ball counts as touching: meshes of few triangles, and tracks, are off by as much."""
TOGETHER_M = 0.0025
"""How much farther than the nearest contact another one may be [m]."""
STAYS_SHARE = 0.9
"""Share of the frames of a beginning in which the ball has to touch."""
SPIN_SHARE, SPIN_LEAST_RAD_S = 0.1, 0.5
"""Standard deviation of such a spin, as a share of it and at least [rad/s]."""
PASSES = 3
"""Number of fits of a beginning, each from the spin of the velocity before: an error shrinks to 2 / 5 from one to the
next."""


def is_ball(body: Body) -> bool:
    """Return whether a body is a ball about its frame's origin and its centre of mass."""
    return body.once(_is_ball)


def _is_ball(body: Body) -> bool:
    if not body.radii.shape[-1]:
        return False
    radius = float(body.radii[0].max())
    off = torch.cat((body.centers[0], body.com)).norm(dim=-1).max()
    return bool(off < 1e-3 * radius) and float(body.radii[0].min()) > 0.999 * radius


def rolling_items(world: World, observations: Observations, frames: Tensor) -> Tensor:
    """Return which items (B,) begin with a ball that rolls or slides, and whose spin nothing measured tells.

    Args:
        world: With a ground or fixed surfaces, and one body.
        observations: The items.
        frames: Frames (B, T) of the beginning.
    """
    none = torch.zeros(len(observations.names), dtype=torch.bool)
    if len(world.bodies) != 1 or world.chains or observations.drives or not is_ball(world.bodies[0]):
        return none
    seen = frames & (observations.seen[:, :, 0] > 0)
    turned = (seen & (observations.has_orientation[:, :, 0] > 0)).any(1)
    spun = observations.first_spin[1][:, 0] if observations.first_spin is not None else none
    asked = (seen.sum(1) >= 2) & ~turned & ~spun
    if not bool(asked.any()):
        return none
    touches = torch.zeros_like(seen)
    gap, _ = _contacts(world, observations.position_m[:, :, 0][seen])
    touches[seen] = gap.amin(1) < NEAR_M
    return asked & (touches.sum(1) >= STAYS_SHARE * seen.sum(1))


def rolling_spins(world: World, position_m: Tensor, velocity_m_s: Tensor) -> Tensor:
    """Return the spins (n, 3) [rad/s, world axes] with which a ball moves on what it touches, 0 where nothing.

    Args:
        world: With one body, a ball.
        position_m: Places of its centre (n, 3).
        velocity_m_s: Its velocities (n, 3).
    """
    body = world.bodies[0]
    radius, gyration = float(body.radii[0].max()), float(body.inertia[0].diagonal().mean() / body.mass[0])
    gap, normal = _contacts(world, position_m)
    weight = ((gap < gap.amin(1, keepdim=True) + TOGETHER_M) & (gap < NEAR_M)).to(gap)
    rows = weight[..., None] * normal
    inverse = torch.linalg.pinv(rows, rtol=0.1)
    velocity = velocity_m_s - (inverse @ (rows @ velocity_m_s[..., None])).squeeze(-1)
    spin = without_slip(normal, weight, velocity, radius)
    pull = world.gravity[:1].expand_as(velocity)
    across = inverse @ (rows @ pull[..., None])
    carried = (torch.linalg.pinv(rows.mT, rtol=0.1) @ -across).squeeze(-1).sum(-1).clamp_min(0.0)
    along = (pull - across.squeeze(-1)).norm(dim=-1)
    arm2 = velocity.square().sum(-1) / spin.square().sum(-1).clamp_min(1e-12)
    law = world.contact
    friction = float(law.friction[0]) * carried if isinstance(law, ContactLaw) else torch.full_like(along, torch.inf)
    rolls = friction >= along * gyration / (gyration + arm2)
    share = friction * arm2 / (gyration * (along - friction).clamp_min(1e-12))
    return torch.where(rolls, 1.0, share.clamp_max(1.0))[:, None] * spin


def without_slip(normal: Tensor, weight: Tensor, velocity_m_s: Tensor, radius_m: float) -> Tensor:
    """Return the smallest spins (n, 3) [rad/s] with which a ball rolls without slip.

    Args:
        normal: Normals of its contacts (n, C, 3).
        weight: 1 for those that count, else 0 (n, C).
        velocity_m_s: Its velocities (n, 3).
        radius_m: Its radius.
    """
    x, y, z = normal.unbind(-1)
    zero = torch.zeros_like(x)
    # omega x r n = -r [n] omega
    turned = -radius_m * torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).unflatten(-1, (3, 3))
    rows = (weight[..., None, None] * turned).flatten(1, 2)
    wanted = (weight[..., None] * velocity_m_s[:, None]).flatten(1)
    return (torch.linalg.pinv(rows, rtol=0.3) @ wanted[..., None]).squeeze(-1)


def with_rolling(world: World, observations: Observations, items: Tensor) -> Observations:
    """Return items (B,) with the spins that their velocities tell, in the axes of the body."""
    index, state = observations.free[0], observations.state
    spin = rolling_spins(world, state.position_m[items, index], state.velocity_m_s[items, index])
    omega = state.omega_body_rad_s.clone()
    turn = quat_to_matrix(state.quat_wxyz[items, index])
    omega[items, index] = (turn.mT @ spin[..., None]).squeeze(-1)
    return replace(observations, state=replace(state, omega_body_rad_s=omega))


def _contacts(world: World, position_m: Tensor) -> tuple[Tensor, Tensor]:
    """Return gaps (n, C) [m] and normals (n, C, 3) of a ball at places (n, 3) to the ground and the fixed surfaces."""
    body, count = world.bodies[0], len(position_m)
    gaps, normals = [], []
    if world.ground_normal is not None and world.ground_offset is not None:
        height = position_m @ world.ground_normal - world.ground_offset[0] - body.radii[0].max()
        gaps.append(height[:, None])
        normals.append(world.ground_normal.expand(count, 1, 3))
    placed = Placed.still(body, position_m, torch.eye(3).to(position_m).expand(count, 3, 3))
    for surface in world.surfaces:
        points = points_within(placed, surface, NEAR_M + TOGETHER_M)
        gaps.append(points.gap)
        normals.append(points.normal)
    if not gaps:
        return position_m.new_full((count, 1), torch.inf), position_m.new_zeros(count, 1, 3)
    return torch.cat(gaps, 1), torch.nan_to_num(torch.cat(normals, 1))
