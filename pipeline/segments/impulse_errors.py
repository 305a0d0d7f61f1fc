"""Errors of the contact law in impacts: impulses of their own, as large as the impacts of the same capture need.

What a law misses shows in impacts far more than in sliding: which corner takes how much of a box's impulse, and when
its slip ends, differs between laws by tenths of the impulse, while all agree on a slide. So each impact of a segment
may have an impulse of its own, beside that of the law: along the normal, across it, a torque about the normal, and one
across it (rocking). They are distributed as Student's t, with scales that are shares of the normal impulse beyond the
weight: some impacts are off by many times what the others are, as those in which another corner strikes first. Shares
and the factor of each impact are those that make the segments likeliest (empirical Bayes, by expectation-maximisation:
Lange, Little & Taylor, "Robust statistical modeling using the t distribution", 1989).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..geometry.rotation import cross, quat_rotate, quat_to_matrix, quat_turn
from ..optimization.problem import NormalEquations
from ..physics.contact_law import ContactLaw
from ..physics.observation_model import measure
from ..physics.rollout import Rollout
from ..physics.state import State
from ..trajectories.residuals import state_prior
from ..trajectories.segmentation import size_of
from .segment_fit import Linear
from .segments import Segments
from .thresholds import SEGMENT_THRESHOLDS

PHASES, LIMITS = SEGMENT_THRESHOLDS.phases, SEGMENT_THRESHOLDS.impulse_errors

KINDS = torch.tensor([0, 1, 1, 2, 3, 3])
"""Kind of error of each of the six components of an impulse: along the normal (0), along the impulse's tangent and
across it (1), and the torques about the normal (2) and about these two tangents (3)."""
SHARE = 0.02
"""Difference step: share of the impulse by which a component is moved up and down."""
FIRST_SHARE, LEAST_SHARE = 0.1, 1e-3
"""Shares from which the estimate starts, and below which it does not go."""
ROUNDS = 60
"""Number of iterations of expectation-maximisation."""


@dataclass(frozen=True, eq=False)
class Impacts:
    """Impacts of segments (B), at most n of each."""

    frame: Tensor
    """Frame after each impact, shape (B, n); -1 where a segment has fewer."""
    columns: Tensor
    """Derivatives of the residuals by the six components of each impulse, as shares of the normal impulse beyond the
    weight, shape (B, T, 6, 6 n); 0 where a segment has fewer."""


@dataclass(frozen=True, eq=False)
class ImpulseErrors:
    """Errors of the impulses of impacts."""

    shares: Tensor
    """Scale of each kind of error, as a share of the normal impulse, shape (4,)."""
    factor: Tensor
    """Factor of the scales of the impact that ends in a frame, shape (B, T)."""

    def of(self, impacts: Impacts) -> Tensor:
        """Return the standard deviations (B, 6 n) of the components of impacts."""
        factor = self.factor.gather(1, impacts.frame.clamp_min(0))
        return (factor[..., None] * self.shares[KINDS]).flatten(1)


def impacts_of(segments: Segments) -> Impacts:
    """Return the impacts of contact segments; none where more than one body moves or nothing strikes the ground."""
    times = segments.observations.times_s
    count = len(times)
    nothing = Impacts(times.new_zeros(count, 0, dtype=torch.long), times.new_zeros(*times.shape, 6, 0))
    if not _applies(segments):
        return nothing
    rollout = segments.rollout(record_contacts=True)
    item, end, impulse = _strikes(segments, rollout)
    if not len(item):
        return nothing
    place = torch.arange(len(item)) - torch.searchsorted(item, item)
    most = 1 + int(place.max())
    frame = torch.full((count, most), -1).index_put((item, place), end)
    columns = times.new_zeros(*times.shape, 6, most, len(KINDS))
    linear, angular = _changes(segments, rollout, item, end, impulse)
    for start in end.unique().tolist():
        chosen = (end == start).nonzero()[:, 0]
        slopes = _slopes(segments, rollout, item[chosen], start, linear[chosen], angular[chosen])
        columns[item[chosen], start:, :, place[chosen]] = slopes
    return Impacts(frame, segments.innovations(columns.flatten(-2)))


def _applies(segments: Segments) -> bool:
    """Return whether one free body meets the ground under the closed-form law, and nothing else."""
    world = segments.world
    alone = len(world.bodies) == 1 and not world.surfaces and not world.chains and world.bodies[0].free
    return alone and world.ground_normal is not None and isinstance(world.contact, ContactLaw)


def _strikes(segments: Segments, rollout: Rollout) -> tuple[Tensor, Tensor, Tensor]:
    """Return segment and frame (K,) of each impact, in order, and its normal impulse beyond the weight [N s]."""
    record, seen = rollout.contacts, segments.observations
    assert record is not None  # the rollout recorded them
    steps = seen.times_s.diff(dim=1)
    weight = segments.world.gravity[0].norm() * torch.cat((steps[:, :1], steps), 1)
    total = (record.impulse_n_s * record.normal).sum((-1, -2))
    mass = segments.world.bodies[0].mass[0]
    beyond = total - mass * weight
    strikes = total > mass * (PHASES.impact_weights * weight).clamp_min(PHASES.impact_m_s)
    frames = torch.arange(total.shape[1])
    # what the last frame shows of an impact is its place alone
    inside = (frames >= 1) & (frames < torch.tensor(segments.lengths)[:, None] - 1)
    item, frame = (strikes & inside).nonzero(as_tuple=True)
    return item, frame, beyond[item, frame]


def _changes(
    segments: Segments, rollout: Rollout, item: Tensor, frame: Tensor, impulse: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the changes of velocity and body-frame spin (K, 6, 3) by each component of each impact."""
    world, record = segments.world, rollout.contacts
    assert record is not None and world.ground_normal is not None
    body, normal = world.bodies[0], world.ground_normal
    quat = rollout.quat_wxyz[item, frame, 0]
    pressed = (record.impulse_n_s * record.normal).sum(-1)[item, frame]
    centers, radii = body.plane_spheres
    # points of the body, as it has moved on since they touched
    point = (centers[0] * pressed[..., None]).sum(1) / pressed.sum(1, keepdim=True)
    radius = (radii[0] * pressed).sum(1, keepdim=True) / pressed.sum(1, keepdim=True)
    offset = quat_rotate(quat, body.com[0].expand_as(point))
    arm = quat_rotate(quat, point) - offset - radius * normal
    total = record.impulse_n_s[item, frame].sum(1)
    tangent = total - (total @ normal)[:, None] * normal
    other = torch.linalg.cross(normal, normal.roll(1)).expand_as(tangent)
    tangent = torch.where(tangent.norm(dim=-1, keepdim=True) > 1e-6 * total.norm(dim=-1, keepdim=True), tangent, other)
    tangent = tangent / tangent.norm(dim=-1, keepdim=True)
    axes = torch.stack((normal.expand_as(tangent), tangent, cross(normal.expand_as(tangent), tangent)), 1)
    force = impulse[:, None, None] * axes
    torque = torch.cat((cross(arm[:, None].expand_as(force), force), LIMITS.arm * size_of(body) * force), 1)
    turn = quat_to_matrix(quat)
    spin = (torch.linalg.inv(body.inertia[:1]) @ (turn.mT @ torque.mT)).mT
    linear = torch.cat((force / body.mass[0], torch.zeros_like(force)), 1)
    # the body's frame moves with its centre of mass
    linear = linear - cross((turn @ spin.mT).mT, offset[:, None].expand_as(linear))
    return linear, spin


def _slopes(segments: Segments, rollout: Rollout, item: Tensor, start: int, linear: Tensor, angular: Tensor) -> Tensor:
    """Return derivatives (K, T - start, 6, 6) of residuals by the components of impacts that end in one frame.

    Args:
        segments: The segments.
        rollout: Their motion.
        item: Segment of each impact (K,).
        start: The frame.
        linear: Changes of the velocity by each component, shape (K, 6, 3).
        angular: The same of the spin in the body's frame.
    """
    seen = segments.observations.select(item.tolist())
    sides = 2 * len(KINDS)
    state = State(
        *(
            part[item, start].repeat(sides, 1, 1)
            for part in (rollout.position_m, rollout.quat_wxyz, rollout.velocity_m_s, rollout.omega_body_rad_s)
        )
    )
    moves = [SHARE * torch.cat((part, -part), 1).movedim(1, 0).flatten(0, 1)[:, None] for part in (linear, angular)]
    state = replace(
        state, velocity_m_s=state.velocity_m_s + moves[0], omega_body_rad_s=state.omega_body_rad_s + moves[1]
    )
    with torch.no_grad():
        end = measure(seen.world(segments.world, sides), state, seen.times_s[:, start:].repeat(sides, 1), {})
    position = end.position_m[:, :, 0].unflatten(0, (2, len(KINDS), -1))
    quat = end.quat_wxyz[:, :, 0].unflatten(0, (2, len(KINDS), -1))
    moved = (position[0] - position[1]) / segments.noise.position_m * seen.seen[:, start:]
    turned = quat_turn(quat[1], quat[0]) / segments.noise.rotation_rad * seen.has_orientation[:, start:]
    slopes = torch.cat((moved, turned), -1) / (2 * SHARE)
    return torch.nan_to_num(slopes, posinf=0.0, neginf=0.0).movedim(0, -1)


def estimated_errors(segments: Segments, rows: Tensor, states: Tensor, impacts: Impacts) -> ImpulseErrors:
    """Return the errors of the impulses that make fitted segments likeliest.

    Args:
        segments: The segments, with fitted states.
        rows: Their residuals, shape (B, T, 6).
        states: Derivatives of these by the states, shape (B, T, 6, S).
        impacts: Their impacts.
    """
    count, acts = impacts.columns.shape[-1], impacts.frame >= 0
    shares, factor = rows.new_full((4,), FIRST_SHARE), torch.ones_like(acts, dtype=rows.dtype)
    frames = rows.new_ones(rows.shape[:2])
    if not count:
        return ImpulseErrors(shares, frames)
    normal = _normal_equations(rows, torch.cat((impacts.columns, states), -1), count).eliminated()
    number = (KINDS == torch.arange(4)[:, None]).sum(1) * acts.sum()
    one = torch.eye(count).to(rows)
    for _ in range(ROUNDS):
        std = (factor[..., None] * shares[KINDS]).flatten(1)
        # in units of their deviations, the components have a precision of 1 beside that of the data
        precision = one + std[:, :, None] * normal.information * std[:, None]
        mean = torch.linalg.solve(precision, (std * normal.score)[..., None])[..., 0]
        spread = torch.linalg.inv(precision).diagonal(dim1=1, dim2=2)
        square = (std**2 * (mean**2 + spread)).unflatten(1, (-1, len(KINDS)))
        weight = (LIMITS.freedom + len(KINDS)) / (LIMITS.freedom + (square / shares[KINDS] ** 2).sum(-1))
        factor = weight.rsqrt()
        by_kind = rows.new_zeros(4).index_add(0, KINDS, (square * (weight * acts)[..., None]).sum((0, 1)))
        shares = (by_kind / number).sqrt().clamp_min(LEAST_SHARE)
    # an impact that another fit has in another frame is as uncertain as the worst of its segment
    frames = frames * torch.where(acts, factor, 1.0).amax(1, keepdim=True)
    item, place = acts.nonzero(as_tuple=True)
    return ImpulseErrors(shares, frames.index_put((item, impacts.frame[item, place]), factor[item, place]))


def projected_with(
    segments: Segments, rows: Tensor, jacobian: Tensor, impacts: Impacts, errors: ImpulseErrors, count: int
) -> Linear:
    """Return the linearization of segments without what their states and errors of their impulses can follow.

    Args:
        segments: The segments.
        rows: Their residuals, shape (B, T, 6).
        jacobian: Derivatives of these by parameters, then states, shape (B, T, 6, P + S).
        impacts: Their impacts.
        errors: Errors of the impulses.
        count: Number P of parameters.
    """
    columns = errors.of(impacts)[:, None, None] * impacts.columns
    equations = _normal_equations(rows, torch.cat((jacobian, columns), -1), count, columns.shape[-1])
    found = equations.eliminated()
    taken = (equations.state_slope * found.state_step).sum(1)
    return Linear(
        information=found.information, score=found.score, chi2=rows.square().sum((1, 2)) - taken, dof=segments.dof
    )


def _normal_equations(rows: Tensor, jacobian: Tensor, count: int, known: int = 0) -> NormalEquations:
    """Return the normal equations of residuals (B, T, 6) by parameters, states, and the impulses of impacts.

    Args:
        rows: The residuals.
        jacobian: Their derivatives, shape (B, T, 6, P + S + K).
        count: Number P of parameters.
        known: Number K of impulses, in units of their deviations.
    """
    error = torch.nan_to_num(rows.flatten(1), posinf=0.0, neginf=0.0)
    flat = torch.nan_to_num(jacobian.flatten(1, 2), posinf=0.0, neginf=0.0)
    prior = torch.cat((state_prior(1).to(error), error.new_ones(known)))
    return NormalEquations.of_rows(error, flat, count, rows.square().sum((1, 2)), prior=prior)
