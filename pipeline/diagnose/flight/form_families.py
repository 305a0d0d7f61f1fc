"""Families of forms that a named force is compared with: when, where, how fast and how spinning a body feels it.

A force may also swing: at so many periods in a usual flight, in one of four phases. A torque that swings does so about
an axis of the world, since none that a body has of its own is known to any effect.

A constant force may be that of a place: of a spring towards it, of a vortex about it, or one that grows along a way
across the room. Such a force is another one at the other end of a flight, and constant in none, but a few short flights
from one hand pass the same places. It has further numbers beside the constant force, which cost what they do in BIC.

Where a force begins or ends to act is a number of its form, and the likelihood is summed over it: at few places where
such a form is one of many, at more of them along the coordinate that the law itself follows, of one likelihood together
before the data. A step is told so sharply by flights that between few places it would be missed.

What a law is least known in is the coordinate that it follows: a drag that is none is likelier to follow the speed in
another way than to act on one side of the room. Before the data, the families of such coordinates are together as
likely as all others. Nothing is known that pushes a body in one direction of the world, by how fast it spins.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...physics.effects.effect import ActiveEffect
from ...segments.flights.force_fields import FlownMotion, ForceField
from ..thresholds import THRESHOLDS
from .coupled_effects import DRAGS

LIMITS = THRESHOLDS.forms

UPWARD = ("gravity_scale", "length_scale", "clock_scale")
"""Effects that change the fall, and nothing across it."""
OWN_TILTS = ("gravity_tilt", "frame_tilt")
"""Effects across gravity of which each episode can have its own, which flight does not tell apart."""
FOLLOWS = {
    **dict.fromkeys(DRAGS, ("speed",)),
    "magnus_lift": ("speed", "spin"),
    "spin_lift": ("speed",),
    "spin_damping": ("spin",),
    "ground_magnet": ("height",),
}
"""Coordinates that the law of an effect follows."""
OTHER_DRAG = {("linear_drag", 1): "quadratic_drag", ("quadratic_drag", -1): "linear_drag"}
"""Powers of the speed that make one drag of the library another one."""


Factors = dict[str, tuple[Tensor, float]]
"""Factors of a force (B, T) by a description in words, each with how likely it is before the data."""


class Family(NamedTuple):
    """Forms of a force that differ in one coordinate."""

    coordinate: str
    """The coordinate."""
    forms: dict[str, ForceField]
    """Each by a description in words."""
    then: str
    """What to record next to tell them apart."""
    shares: tuple[float, ...] = ()
    """How likely each is before the data, in units of one of the others; none where all are alike."""


def own_field(motion: FlownMotion, active: ActiveEffect) -> ForceField | None:
    """Return the force of an effect along flights, by its parameters; None for what is no force, as an offset."""
    field, name = motion.field_of(active), active.effect.name
    if field is not None:
        return field
    up, level = motion.axes
    axes = {**dict.fromkeys(UPWARD, up), **dict.fromkeys(OWN_TILTS, level)}.get(name)
    return None if axes is None else _everywhere(motion, axes)


def laws_of(motion: FlownMotion, own: ForceField, named: tuple[str, ...]) -> list[ForceField]:
    """Return the laws of an effect and of its equals that are others, its own the first.

    These are a drag that is not told from the other one, and a constant force.

    Args:
        motion: The flights.
        own: The force.
        named: Names of the effect and of its equals.
    """
    size = _in_medians(motion, "speed", motion.velocity_m_s)
    steady = _constant(motion, own, named)
    return [own, *(own.times(size**power) for power in _known_powers(named)), *([] if _is_constant(own) else steady)]


def _constant(motion: FlownMotion, own: ForceField, named: tuple[str, ...]) -> list[ForceField]:
    """Return the constant force that an effect or one of its equals is; none where none is one."""
    if _is_constant(own):
        return [own]
    up, level = motion.axes
    if "constant_force" in named:
        return [_everywhere(motion, torch.cat((up, level), 1))]
    return [_everywhere(motion, level)] if set(OWN_TILTS) & set(named) else []


def _everywhere(motion: FlownMotion, axes: Tensor) -> ForceField:
    """Return forces along axes (3, K), the same in all frames."""
    shape = (*motion.times_s.shape, *axes.shape)
    return ForceField(axes.expand(shape).clone(), torch.zeros(shape, dtype=torch.float64))


def _known_powers(named: tuple[str, ...]) -> set[int]:
    """Return the powers of the speed that make the drag of a name that of one of its equals."""
    return {power for (drag, power), other in OTHER_DRAG.items() if drag in named[:1] and other in named}


def families_of(motion: FlownMotion, own: ForceField, named: tuple[str, ...], of_places: bool = True) -> list[Family]:
    """Return the forms of a force, in families of one coordinate.

    Args:
        motion: The flights.
        own: The force.
        named: Names of the effect and of its equals; what one of these is, is no other form.
        of_places: Whether to include forces that have further numbers, which change from place to place.
    """
    same = "the same torque" if bool(own.turning.any()) else "the same force"
    place = dict(zip(("x", "y", "height"), motion.com_m.unbind(-1), strict=True))
    level = {**_where(motion, "x", place["x"]), **_where(motion, "y", place["y"])}
    follows = FOLLOWS.get(named[0], ())
    speed = _how_fast(motion, "speed", motion.velocity_m_s, _known_powers(named), "speed" in follows)
    spin = {} if _is_constant(own) else _how_fast(motion, "spin", motion.omega_rad_s, set(), "spin" in follows)
    found = {
        "time": (_alike(_when(motion)), "record shorter and longer flights"),
        "height": (_alike(_where(motion, "height", place["height"])), "record lower and higher flights"),
        "place": (_alike(level), "record flights elsewhere"),
        "speed": (speed, "record slower and faster flights"),
        "spin": (spin, "record flights with less and with more spin"),
    }
    families = [
        Family(
            coordinate,
            {f"{same} {words}": own.times(factor) for words, (factor, _) in factors.items()},
            then,
            tuple(share for _, share in factors.values()),
        )
        for coordinate, (factors, then) in found.items()
    ]
    steady = _constant(motion, own, named) if of_places else []
    if steady:
        place = next(k for k, family in enumerate(families) if family.coordinate == "place")
        further = _of_places(motion, steady[0])
        families[place].forms.update(further)
        families[place] = families[place]._replace(shares=(*families[place].shares, *[1.0] * len(further)))
    return [family for family in (*families, _swinging(motion, own)) if family.forms]


def weights_of(families: Sequence[Family], name: str) -> list[float]:
    """Return how likely each family of other forms of an effect is before the data, in units of the least likely."""
    own = [family.coordinate in FOLLOWS.get(name, ()) for family in families]
    near = max(len(own) - sum(own), 1) / max(sum(own), 1)
    return [near if one else 1.0 for one in own]


def _is_constant(field: ForceField) -> bool:
    """Return whether a force has the same size and direction in the world in all frames, and no torque."""
    first = field.acceleration[:1, :1]
    return not bool(field.turning.any()) and bool((field.acceleration - first).abs().max() <= 1e-6 * first.abs().max())


def _usual_flight_s(lengths_s: Tensor) -> float:
    """Return the duration of a usual flight [s] from those of all (B, 1)."""
    return float(np.quantile(lengths_s[:, 0].numpy(), LIMITS.usual_flight))


def _when(motion: FlownMotion) -> Mapping[str, Tensor]:
    """Return factors of a force that sets in or ends, or does both."""
    since, left = motion.spans_s
    usual, found = _usual_flight_s(since + left), {}
    for share in LIMITS.shares:
        on = (since > share * usual).double()
        found |= {f"from {share * usual:.2g} s of a flight on": on, f"until {share * usual:.2g} s of a flight": 1 - on}
    for first, last in itertools.combinations(LIMITS.shares, 2):
        on = ((since > first * usual) & (since <= last * usual)).double()
        found[f"from {first * usual:.2g} to {last * usual:.2g} s of a flight"] = on
    return found


def _swinging(motion: FlownMotion, own: ForceField) -> Family:
    """Return a force that swings along its own direction, or a torque that does so about an axis of the world."""
    since, left = motion.spans_s
    usual, torque = _usual_flight_s(since + left), bool(own.turning.any())
    if torque:
        axes = torch.eye(3, dtype=torch.float64).expand(*since.shape, 3, 3)
        own = ForceField(torch.zeros_like(axes), axes)
    words = "a torque about one axis of the world" if torque else "the same force"
    found = {}
    for periods, phase in itertools.product(LIMITS.periods, LIMITS.phases):
        swing = torch.sin(math.pi * (2 * periods * since / usual + phase))
        at = f" in phase {180 * phase:.0f} deg" if phase else ""
        found[f"{words}, swinging at {periods / usual:.2g} Hz{at}"] = own.times(swing)
    return Family("swinging", found, "record longer flights")


def _where(motion: FlownMotion, name: str, values: Tensor) -> Mapping[str, Tensor]:
    """Return factors of a force that acts on one side of a place, or grows with it."""
    edge = motion.median(values)
    on = (values > edge).double()
    words = {f"where {name} is above {edge:.2g} m": on, f"where {name} is below {edge:.2g} m": 1 - on}
    return {**words, f"times {name}": values}


def _of_places(motion: FlownMotion, own: ForceField) -> Mapping[str, ForceField]:
    """Return a constant force beside one that changes from place to place, along the directions of the constant one."""
    basis = torch.linalg.qr(own.acceleration[0, 0]).Q
    away = motion.com_m - motion.com_m[motion.inside].mean(0)
    along = (away @ basis @ basis.T)[..., None]
    up, level = motion.axes
    found = {"a force towards a place, which grows with the distance": [along]}
    if basis.shape[1] > 1:
        around = torch.linalg.cross(up[:, 0].expand_as(away), away)[..., None]
        found["a force around a place, which grows with the distance"] = [around]
    across = away @ level
    found["a force that changes across the room"] = [own.acceleration * across[..., None, k : k + 1] for k in range(2)]
    return {
        words: ForceField.joined([own, *(ForceField(one, torch.zeros_like(one)) for one in more)])
        for words, more in found.items()
    }


def _alike(factors: Mapping[str, Tensor]) -> Factors:
    """Return factors none of which is likelier than another before the data."""
    return {words: (factor, 1.0) for words, factor in factors.items()}


def _how_fast(motion: FlownMotion, name: str, vectors: Tensor, known: set[int], follows: bool) -> Factors:
    """Return factors of a force by other powers of speed or spin, or on one side of it; none where it has no spread.

    Args:
        motion: The flights.
        name: Speed or spin.
        vectors: Velocities or spins (B, T, 3).
        known: Powers that make the force another one that is known.
        follows: Whether the law of the force follows it.
    """
    plain, size = vectors.norm(dim=-1), _in_medians(motion, name, vectors)
    if not bool((size[motion.inside] - 1).abs().max() > 1e-6):
        return {}
    found = _alike(
        {f"times the {name} to the power {power}": size**power for power in LIMITS.powers if power not in known}
    )
    edges = LIMITS.own_edges if follows else LIMITS.edges
    share = len(LIMITS.edges) / len(edges)
    for edge in torch.quantile(plain[motion.inside], torch.tensor(edges, dtype=plain.dtype)).tolist():
        on = (plain > edge).double()
        words = f"{edge:.2g} {'m/s' if name == 'speed' else 'rad/s'} alone"
        for side, factor in (
            (f"where the {name} is above {words}", on),
            (f"where the {name} is below {words}", 1 - on),
        ):
            found[side] = (factor, share + found.get(side, (factor, 0.0))[1])
    return found


def _in_medians(motion: FlownMotion, name: str, vectors: Tensor) -> Tensor:
    """Return speeds or spins (B, T) in their median, the slowest taken as those of which the direction is known."""
    size = vectors.norm(dim=-1).clamp_min(LIMITS.slowest[name == "spin"])
    return size / motion.median(size)
