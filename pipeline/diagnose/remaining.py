"""What the selected effects leave in flight and in contact, and what they gain in held-out episodes.

No candidate stands for the law of contact: where impacts or slides are off by many times the noise and no effect
explains it, that nothing is missing would be wrong. A phase counts as badly described where most of its segments are,
not where one impact is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TypedDict

import numpy as np
import torch
from torch import Tensor

from ...schemas import PhaseMisfit, Remaining
from ..optimization.tails import student_quantile
from ..segments.contact_phases import PHASES, PhaseName, contact_phases
from ..segments.prepare import whole_flights
from ..segments.segment_states import fit_states
from ..segments.segments import Segments
from ..segments.sliding.fit import StartedSliding, nuisance_parameters
from ..trajectories.innovations import WHITE
from .evidence.evidence import Evidence
from .flight.findings import FlightFindings
from .thresholds import THRESHOLDS

LIMITS = THRESHOLDS.verdict

NEXT: dict[PhaseName, str] = {
    "impact": "drop the body without spin onto one face at several speeds, and check its shape and the frame rate",
    "sliding": "record slides in several directions on the same ground, and check the shape and the ground's height",
    "rolling": "roll the body slowly in several directions, and check its radius and whether the ground is level",
    "sticking": "tip the body over its edges slowly, and check its shape and centre of mass",
    "rest": "record the body at rest on each face, and check the ground's height, its tilt, and how the markers sit",
}
"""What to record and check next where a phase is badly described."""


class HeldOut(TypedDict):
    """Fields of a ranked effect."""

    held_out_nats: float | None
    held_out_nats_95: tuple[float, float] | None


def held_out_of(evidence: Evidence) -> HeldOut:
    """Return the gain of the log-likelihood of held-out episodes, and its interval from the scatter between them."""
    gains = 0.5 * np.array(evidence.gains)
    if len(gains) < 2:
        return {"held_out_nats": None, "held_out_nats_95": None}
    total = float(gains.sum())
    reach = student_quantile(0.975, len(gains) - 1) * float(gains.std(ddof=1)) * math.sqrt(len(gains))
    return {"held_out_nats": total, "held_out_nats_95": (total - reach, total + reach)}


def remaining_of(found: FlightFindings) -> Remaining | None:
    """Return what is left in flight beside the selected effects; None without flight."""
    if found.segments is None:
        return None
    position, rotation = _residuals(_whole(found, found.segments))
    std, slow, left = found.prepared.noise.position_m, found.slow, found.left
    return Remaining(
        position_rms_m=position,
        rotation_rms_rad=rotation,
        slow_position_std_m=0.0 if slow is None else slow.position_m(std),
        slow_time_s=None if slow is None else slow.noise_model.position.slow_time_s,
        own_acceleration_std_m_s2=0.0 if slow is None else slow.sway_m_s2(std),
        repeats=found.repeats,
        coordinate=None if left is None else left.coordinate,
        p_value=None if left is None else left.p_value,
        share_explained=min(max(found.common_share, 0.0), 1.0),
    )


def _whole(found: FlightFindings, segments: Segments) -> Segments:
    """Return segments of flights whole: where nothing slow shows, the search cuts them."""
    items = whole_flights(segments.items)
    if len(items) == len(segments.items):
        return segments
    return fit_states(found.prepared.segments("flight", found.world, items))


def _residuals(segments: Segments) -> tuple[float, float | None]:
    """Return the root mean square distance [m] and rotation [rad] between measurement and model."""
    plain = Segments(
        kind=segments.kind,
        world=segments.world,
        items=segments.items,
        observations=replace(segments.observations, time_shift=None),
        noise=segments.noise,
        noise_model=WHITE,
    )
    rows = plain.residuals([], segments.world.gravity.new_zeros(0), jacobian=False)[0]
    seen = segments.observations
    found = []
    for part, mask, std in zip(rows.split(3, 2), (seen.seen, seen.has_orientation), segments.noise, strict=True):
        count = float(mask.sum())
        found.append(std * math.sqrt(float(part.square().sum()) / count) if count else None)
    return found[0] or 0.0, found[1]


def misfits_of(contact: Segments) -> list[PhaseMisfit]:
    """Return how each phase of contact is described, the worst first, from segments with fitted states."""
    none = contact.world.gravity.new_zeros(0)
    chi2 = contact.residuals([], none, jacobian=False)[0].square().flatten(1).sum(1) / contact.dof.clamp_min(1.0)
    seen = replace(contact.observations, time_shift=None)
    plain = replace(contact, noise_model=WHITE, observations=seen).residuals([], none, jacobian=False)[0]
    causes = [_cause(phases) for phases in contact_phases(contact)]
    found = []
    for phase in PHASES[1:]:
        own = [k for k, cause in enumerate(causes) if cause == phase]
        if own:
            found.append(_misfit(phase, contact.select(own), chi2[own], plain[own]))
    return sorted(found, key=lambda one: -one.reduced_chi2)


def slides_of(sliding: StartedSliding | None) -> list[PhaseMisfit]:
    """Return how one friction describes whole slides; empty where none moves.

    A friction that changes from place to place bends long slides, of which pieces of a tenth of a second show nothing.
    """
    if sliding is None:
        return []
    found, seen = sliding.base, sliding.base.segments.observations
    least = LIMITS.moved_sigmas * found.segments.noise.position_m
    last = [seen.position_m[k, n - 1, 0] for k, n in enumerate(found.segments.lengths)]
    moved = [k for k, at in enumerate(last) if float((at - seen.position_m[k, 0, 0]).norm()) > least]
    if not moved:
        return []
    chosen = found.segments.select(moved)
    parameters = nuisance_parameters(chosen.world, sliding.flight_parameters)
    rows = torch.nan_to_num(chosen.residuals(parameters, found.values[0], jacobian=False)[0])
    dof = chosen.dof.clamp_min(1.0)
    one = _misfit("sliding", chosen, found.chi2[moved] / dof, rows)
    own = sliding.separate.chi2[moved] / dof
    if float(own.median()) < 0.5 * one.reduced_chi2:
        low, high = sliding.separate.values[moved, 0].exp().quantile(own.new_tensor([0.1, 0.9])).tolist()
        text = (
            f"{_OTHER_PLACES}: with a friction of its own, most of {low:.2g} to {high:.2g}, each of these is described"
        )
        return [one.model_copy(update={"then": text})]
    return [one]


_OTHER_PLACES = "record the same slide across different places of the ground, from both sides and at two speeds"


def bad_ones(misfits: Sequence[PhaseMisfit]) -> list[PhaseMisfit]:
    """Return the phases that the law of contact does not describe, the worst first."""
    return [one for one in misfits if one.segments >= LIMITS.misfit_segments and one.reduced_chi2 > _most(one)]


def _most(one: PhaseMisfit) -> float:
    """Return the chi2 per degree of freedom above which a phase is badly described."""
    return LIMITS.slide_chi2 if one.segment_s >= LIMITS.slide_s else LIMITS.misfit_chi2


def _cause(phases: Sequence[PhaseName]) -> PhaseName:
    """Return the phase that a segment's errors count for: an impact if it has one, else its most frequent contact."""
    touching: list[PhaseName] = [phase for phase in phases if phase != "flight"]
    if "impact" in touching or not touching:
        return "impact" if touching else "flight"
    return max(PHASES[1:], key=touching.count)


def _misfit(phase: PhaseName, segments: Segments, chi2: Tensor, rows: Tensor) -> PhaseMisfit:
    """Return how a phase is described.

    Args:
        phase: The phase.
        segments: Its segments (B).
        chi2: Their chi2 per degree of freedom, shape (B,).
        rows: Their residuals in units of white noise, shape (B, F, 6).
    """
    seen = segments.observations
    sizes = []
    for part, mask, std in zip(rows.split(3, 2), (seen.seen, seen.has_orientation), segments.noise, strict=True):
        square, count = part.square().flatten(1).sum(1), mask.flatten(1).sum(1)
        known = count > 0
        sizes.append(std * math.sqrt(float((square[known] / count[known]).median())) if bool(known.any()) else None)
    length = [float(seen.times_s[k, n - 1] - seen.times_s[k, 0]) for k, n in enumerate(segments.lengths)]
    return PhaseMisfit(
        phase=phase,
        segments=len(segments.items),
        segment_s=float(np.median(length)),
        reduced_chi2=float(torch.nan_to_num(chi2, nan=math.inf).median()),
        position_rms_m=sizes[0] or 0.0,
        rotation_rms_rad=sizes[1],
        then=NEXT[phase],
    )
