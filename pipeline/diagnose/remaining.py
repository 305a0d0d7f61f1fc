"""What the selected effects leave in flight, and what they gain in held-out episodes, as the result states them."""

from __future__ import annotations

import math
from typing import TypedDict

import numpy as np

from ...schemas import Remaining
from ..optimization.uncertainty import student_quantile
from ..segments.prepare import whole_flights
from ..segments.segment_states import fit_states
from ..segments.segments import Segments
from ..trajectories.innovations import WHITE
from .evidence import Evidence
from .flight_findings import FlightFindings


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
        observations=segments.observations,
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
