"""Hidden effects of the measurement: the motion is correct, its record is not."""

from __future__ import annotations

import numpy as np

from .mechanics import Hidden
from .registry import direction, hidden_effect, horizontal, sign
from .rotation import turn
from .things import Array, Thing


@hidden_effect("length_scale", "measurement", 0.01, 0.03)
def length_scale(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """Positions scaled by 1 + s about the world's origin, s [1] of either sign; the shape in the manifest stays."""
    s = size * sign(rng)

    def observe(position: Array, rotation: Array) -> tuple[Array, Array]:
        return (1 + s) * position, rotation

    return Hidden(name="length_scale", values={"s": s}, form="p_measured = (1 + s) p", observe=observe)


@hidden_effect("frame_tilt", "measurement", 0.7, 2.0)
def frame_tilt(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """Poses rotated about a horizontal axis through the world's origin, by an angle [deg]."""
    vector = np.radians(size) * horizontal(rng)
    matrix = turn(vector)

    def observe(position: Array, rotation: Array) -> tuple[Array, Array]:
        return position @ matrix.T, matrix @ rotation

    values = {"tilt_x": vector[0], "tilt_y": vector[1]}
    return Hidden(
        name="frame_tilt", values=values, form="p_measured = R p, R = exp(tilt_x e_x + tilt_y e_y)", observe=observe
    )


@hidden_effect("clock_scale", "measurement", 0.01, 0.03)
def clock_scale(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """Times multiplied by 1 + s, s [1] of either sign."""
    s = size * sign(rng)
    return Hidden(name="clock_scale", values={"s": s}, form="t_measured = (1 + s) t", clock=1 + s)


@hidden_effect("marker_offset", "measurement", {"cube": 0.002, "ball": 0.001}, {"cube": 0.006, "ball": 0.004})
def marker_offset(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """The tracked point displaced from the body frame's origin by d [m], body frame."""
    d = size * direction(rng)

    def observe(position: Array, rotation: Array) -> tuple[Array, Array]:
        return position + rotation @ d, rotation

    values = {f"d_{axis}": float(value) for axis, value in zip("xyz", d, strict=True)}
    return Hidden(name="marker_offset", values=values, form="p_measured = p + R d", observe=observe)
