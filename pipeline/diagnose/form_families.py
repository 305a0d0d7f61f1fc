"""Families of forms that a named force is compared with: when, where, how fast and how spinning a body feels it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from ..physics.effects.effect import ActiveEffect
from ..segments.force_fields import FlownMotion, ForceField

UPWARD = ("gravity_scale", "length_scale", "clock_scale")
"""Effects that change the fall, and nothing across it."""
LEVEL = ("gravity_tilt", "frame_tilt", "wind")
"""Effects that push across gravity the same way everywhere: a wind through a drag, a tilt by gravity's component."""
USUAL_FLIGHT = 0.75
"""Quantile of the episodes' flights of which times are shares."""
SHARES = (0.15, 0.3, 0.45, 0.6)
"""Shares of a usual flight at which a force sets in or ends."""
QUANTILES = (0.3, 0.5, 0.7)
"""Quantiles of a coordinate over all frames of flight beyond which a force acts."""
POWERS = (-1.0, 1.0, 2.0)
"""Powers of speed and spin, in their medians, that a force is multiplied by."""
SLOW_M_S, SLOW_RAD_S = 0.05, 0.3
"""Speed and spin below which powers of them are those there: the direction of rest is unknown."""


def own_field(motion: FlownMotion, active: ActiveEffect) -> ForceField | None:
    """Return the force of an effect along flights, by its parameters; None for what is no force, as an offset."""
    field, name = motion.field_of(active), active.effect.name
    if field is not None:
        return field
    up, level = motion.axes
    if name in UPWARD:
        return _constant(motion, up)
    return _constant(motion, level) if name in LEVEL else None


def forms_of(motion: FlownMotion, own: ForceField) -> dict[str, ForceField]:
    """Return the forms of a force, by a description in words."""
    same = "the same torque" if bool(own.turning.any()) else "the same force"
    factors = (*_when(motion), *_where(motion), *_how_fast(motion))
    found = {f"{same} {words}": own.times(factor) for words, factor in factors}
    # what turns the body is compared with itself alone: a torque of another direction is no form of it
    return found if bool(own.turning.any()) else {**found, **_elsewhere(motion)}


def _constant(motion: FlownMotion, axes: Tensor) -> ForceField:
    """Return unit accelerations along axes (3, K)."""
    shape = (*motion.times_s.shape, *axes.shape)
    return ForceField(axes.expand(shape).clone(), torch.zeros(shape, dtype=torch.float64))


def usual_flight_s(motion: FlownMotion) -> float:
    """Return the length of a usual flight [s]."""
    since, left = motion.spans_s
    return float(np.quantile((since + left)[:, 0].numpy(), USUAL_FLIGHT))


def _when(motion: FlownMotion) -> Iterator[tuple[str, Tensor]]:
    """Yield factors of a force that sets in, ends, grows or fades."""
    since, usual = motion.spans_s[0], usual_flight_s(motion)
    for share in SHARES:
        on = (since > share * usual).double()
        yield f"from {share * usual:.2g} s of a flight on", on
        yield f"until {share * usual:.2g} s of a flight", 1 - on
    yield "growing with the time", since / usual
    yield "fading with the time", (1 - since / usual).clamp_min(0.0)


def _where(motion: FlownMotion) -> Iterator[tuple[str, Tensor]]:
    """Yield factors of a force that acts on one side of a place, or grows with it."""
    for name, values in zip(("x", "y", "height"), motion.com_m.unbind(-1), strict=True):
        for share in QUANTILES:
            edge = motion.quantile(values, share)
            on = (values > edge).double()
            yield f"where {name} is above {edge:.2g} m", on
            yield f"where {name} is below {edge:.2g} m", 1 - on
        yield f"times {name}", values


def _how_fast(motion: FlownMotion) -> Iterator[tuple[str, Tensor]]:
    """Yield factors of a force by another power of speed or spin."""
    vectors = {"speed": (motion.velocity_m_s, SLOW_M_S), "spin": (motion.omega_rad_s, SLOW_RAD_S)}
    for name, (vector, least) in vectors.items():
        size = vector.norm(dim=-1)
        size = size.clamp_min(least) / max(motion.quantile(size, 0.5), least)
        for power in POWERS:
            yield f"times the {name} to the power {power:g}", size**power


def _elsewhere(motion: FlownMotion) -> dict[str, ForceField]:
    """Return forces of directions that the named one does not have; with more numbers, BIC counts them."""
    place, velocity, spin = motion.com_m, motion.velocity_m_s, motion.omega_rad_s
    up, level = motion.axes
    level_place, level_velocity = (values @ level @ level.T for values in (place, velocity))
    across = torch.linalg.cross(up[:, 0].expand_as(velocity), level_velocity)
    speed, level_speed = (values.norm(dim=-1, keepdim=True) for values in (velocity, level_velocity))
    left = across / level_speed.clamp_min(SLOW_M_S)
    steady, upward = _constant(motion, level), up[:, 0].expand_as(place)
    angle = 2 * torch.atan2(*reversed((velocity @ level).unbind(-1)))[..., None]
    lift = torch.linalg.cross(spin, velocity)
    found = {
        "a force as of a spring to a vertical line": ForceField.joined([_along(-level_place), steady]),
        "a force as of a whirl about a vertical line": ForceField.joined(
            [_along(torch.linalg.cross(upward, level_place)), steady]
        ),
        "a force across the path, by its heading": ForceField.joined(
            [_along(left * angle.cos()), _along(left * angle.sin())]
        ),
        "a force across the path": _along(left),
        "a force against the motion, the same at all speeds": _along(-velocity / speed.clamp_min(SLOW_M_S)),
        "a force against the motion, by the cube of the speed": _along(-velocity * speed.square()),
        "a force upwards, by the square of the level speed": _along(upward * level_speed.square()),
        "a force across spin and velocity, by the square of the spin": _along(lift * spin.norm(dim=-1, keepdim=True)),
        "a force along the spin": _along(spin),
    }
    return {words: field for words, field in found.items() if bool(field.acceleration.any())}


def _along(vectors: Tensor) -> ForceField:
    """Return accelerations (B, T, 3) as a field of one number."""
    return ForceField(vectors[..., None], torch.zeros_like(vectors[..., None]))
