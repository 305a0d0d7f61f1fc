"""Rolls and slides on fixed surfaces to record next: those that tell effects apart which the data do not.

They begin where recorded ones began or ended, at rest or along their ways, so that they can be made on the same track.
Each is simulated with the likeliest effect; the rival, at its own estimate, is fitted to it by the start, and what it
leaves is what the motion shows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ....schemas import NextMotions, ProposedMotion
from ...geometry.rotation import quat_to_matrix
from ...physics.state import State
from ...segments.candidates import Together, Variant, base_values, variants_of
from ...segments.contact_phases import is_round
from ...segments.segments import Segments
from ...segments.sliding.descent import fit_groups
from ...segments.sliding.fit import StartedSliding
from ...segments.sliding.support import Support, within_of
from ...segments.thresholds import SEGMENT_THRESHOLDS
from ...trajectories.residuals import STATE_SIZE, TrajectoryResiduals
from ..contact.contact_test import variant_of
from ..evidence.evidence import Evidence
from ..thresholds import THRESHOLDS
from ..verdict import Findings
from .experiments import described

LIMITS = SEGMENT_THRESHOLDS.sliding_data

SPEEDS_M_S = (0.0, 0.4, 0.8)
"""First speeds along the recorded way, down it and back up it."""
DURATION_S, RATE_HZ = 2.0, 100.0
"""Of the simulated motions."""
MOST_RIVALS, MOST_MOTIONS = 3, 3
"""Numbers of rivals that motions are chosen for, and of motions."""
LEAST_S = 0.3
"""Shortest motion [s]."""


def surface_motions(findings: Findings) -> NextMotions | None:
    """Return up to three motions on the surfaces; None where the data leave no effects to tell apart, or none does."""
    started = findings.sliding
    equals = next((one.equals for one in findings.chosen if one.where == "contact" and len(one.equals) > 1), ())
    if started is None or not equals:
        return None
    starts = _starts(started.base.segments)
    found = _Compared(started, equals[: 1 + MOST_RIVALS], starts).misfits()
    least = found.misfit.amin(0)
    order = [k for k in least.argsort(descending=True).tolist() if float(least[k]) > THRESHOLDS.sliding.lead][
        :MOST_MOTIONS
    ]
    if not order:
        return None
    index = started.segments.observations.free[0]
    return NextMotions(
        motions=tuple(
            ProposedMotion(
                what=_words(starts, k, index, is_round(started.segments.world.bodies[index])),
                initial_state=described(starts, k, index),
                duration_s=round(found.duration_s[k], 2),
            )
            for k in order
        ),
        separates=tuple(sorted(one.name for one in equals[: 1 + MOST_RIVALS])),
    )


def _starts(segments: Segments) -> State:
    """Return where motions may begin (K): at both ends of up to three recorded ones, at several speeds."""
    seen, world = segments.observations, segments.world
    index, rows = seen.free[0], []
    motion = segments.positions()[:, :, 0]
    lengths = [float((motion[k, n - 1] - motion[k, 0]).norm()) for k, n in enumerate(segments.lengths)]
    for k in sorted(range(len(lengths)), key=lambda k: -lengths[k])[:3]:
        last = segments.lengths[k] - 1
        for frame, sign in ((0, 1.0), (last, -1.0)):
            one = seen.state.at(torch.tensor([k]))
            fields = [value.clone() for value in one.tensors]
            fields[0][:, index] = motion[k, frame]
            ahead = motion[k, min(frame + 3, last)] - motion[k, max(frame - 3, 0)]
            along = sign * torch.nn.functional.normalize(ahead, dim=-1)
            near = Support.of(world, index, fields[0][:, index], fields[1][:, index], LIMITS.near_surface_m)
            for speed in SPEEDS_M_S:
                own = [value.clone() for value in fields]
                own[2][:, index] = speed * along
                own[3][:, index] = 0.0
                if is_round(world.bodies[index]):
                    radius = float(world.bodies[index].radii[0].max())
                    spin = near.rolling(within_of(segments.noise.position_m), own[2][:, index], radius)
                    own[3][:, index] = (quat_to_matrix(own[1][:, index]).mT @ spin[..., None]).squeeze(-1)
                rows.append(State(*own))
    return State.joined(*rows)


@dataclass(frozen=True)
class _Misfits:
    """What rivals leave of motions (K)."""

    misfit: Tensor
    """Chi2 by rival and motion, shape (R, K)."""
    duration_s: list[float]
    """Time [s] until each leaves the surfaces or meets a wall (K)."""


class _Compared:
    """Motions with one effect, to which others are fitted by the start."""

    def __init__(self, started: StartedSliding, equals: Sequence[Evidence], starts: State) -> None:
        self.started, self.starts = started, starts
        self.soft = started.segments.world
        candidates = [one.candidate for one in equals]
        every = variants_of(candidates, self.soft.gravity[0, :1])
        variants: list[Variant] = [variant_of(one, every, candidates) for one in equals]
        self.together = Together.of(self.soft, variants)
        parameters = self.together.parameters
        self.values = base_values(self.together.world, parameters).repeat(len(equals), 1)
        self.together.set_constants(self.values, 0)
        for row, one, columns in zip(self.values, equals, self.together.columns, strict=True):
            numbers = [value for value, _ in one.estimates.values()]
            row[columns] = torch.tensor([parameters[c].encode(v) for c, v in zip(columns, numbers, strict=True)]).to(
                row
            )

    def misfits(self) -> _Misfits:
        """Return what the effects after the first leave of motions that the first makes."""
        made = self._made()
        count, rivals = len(self.starts.position_m), len(self.values) - 1
        every = made.select(list(range(count)) * rivals)
        values = self.values[1:].repeat_interleave(count, 0)
        free = torch.full((len(values), 1), -1)
        found = fit_groups(every, self.together.parameters, values, free, torch.arange(len(values)))
        ends = (made.observations.seen[:, :, 0].sum(1) / RATE_HZ).tolist()
        long = torch.tensor([end >= LEAST_S for end in ends]).to(found.chi2)
        return _Misfits(found.chi2.unflatten(0, (rivals, count)) * long, ends)

    def _made(self) -> Segments:
        """Return the motions with the first effect as if they had been measured without noise."""
        base, count = self.started.segments, len(self.starts.position_m)
        times = torch.arange(round(DURATION_S * RATE_HZ)).to(base.observations.times_s) / RATE_HZ
        shape = (count, len(times), 1)
        seen = replace(
            base.observations.select([0] * count),
            times_s=times.expand(count, -1),
            seen=torch.ones(shape).to(times),
            has_orientation=torch.zeros(shape).to(times),
            position_m=torch.zeros(*shape, 3).to(times),
            quat_wxyz=torch.tensor([1.0, 0, 0, 0]).to(times).expand(*shape, 4),
            state=self.starts,
            carried=None,
        )
        problem = TrajectoryResiduals(self.together.world, self.together.parameters, seen, *base.noise)
        change = torch.zeros(count, STATE_SIZE).to(times)
        rollout = problem.rollout(self.values[0], change)
        index = base.observations.free[0]
        position, quat = rollout.position_m[:, :, index], rollout.quat_wxyz[:, :, index]
        within = within_of(base.noise.position_m)
        near = Support.of(self.soft, index, position.flatten(0, 1), quat.flatten(0, 1), LIMITS.near_surface_m + within)
        on = near.gap_m.amin(1).view(shape[:2]) < LIMITS.near_surface_m
        jump = position.diff(n=2, dim=1).norm(dim=-1) * RATE_HZ < LIMITS.jump_m_s
        steady = torch.cat((torch.ones_like(on[:, :1]), jump, torch.ones_like(on[:, :1])), 1)
        kept = (on & steady).to(times).cumprod(1)[..., None]
        turned = torch.zeros_like(kept) if is_round(self.soft.bodies[index]) else kept
        seen = replace(
            seen,
            seen=kept,
            has_orientation=turned,
            position_m=position[:, :, None],
            quat_wxyz=quat[:, :, None],
            carried=near.carried(within).view(*shape[:2], 3, 3),
        )
        items = base.items[:1] * count
        return replace(base, items=items, observations=seen).in_world(self.together.world)


def _words(starts: State, item: int, index: int, ball: bool) -> str:
    """Return a motion in words."""
    place = ", ".join(f"{100 * x:.0f}" for x in starts.position_m[item, index].tolist())
    velocity = starts.velocity_m_s[item, index]
    speed = float(velocity.norm())
    if speed == 0:
        return f"let it go from rest at ({place}) cm"
    way = ", ".join(f"{x + 0.0:.1f}" for x in (velocity / speed).tolist())
    rising = float(velocity[2]) > math.sin(math.radians(1)) * speed
    verb = "roll" if ball else "slide"
    return f"{verb} it {'up' if rising else 'on'} from ({place}) cm at {speed:.1f} m/s along ({way})"
