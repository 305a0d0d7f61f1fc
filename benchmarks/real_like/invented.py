"""More hidden forces that are in no library: some for development, others for reports alone.

Those of `cgwm.datasets.synthetic.hidden_effects.unknown` were known when rules about them were made. A rule that was
made to know them says nothing of the next one: the reports from report9 on have laws that no development capture has.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from cgwm.datasets.synthetic.hidden_effects.mechanics import Hidden, Moment, Wrench
from cgwm.datasets.synthetic.hidden_effects.registry import direction, hidden_effect, horizontal, sign
from cgwm.datasets.synthetic.hidden_effects.things import Array, Thing

_UP = np.array([0.0, 0.0, 1.0])
_NONE = np.zeros(3)
Law = Callable[[Moment], Array]


def _pushed(name: str, values: dict[str, float], form: str, acceleration: Law) -> Hidden:
    """Return an effect that is an acceleration [m/s2]."""

    def wrench(now: Moment) -> Wrench:
        return now.mass_kg * acceleration(now), _NONE

    return Hidden(name=name, values=values, form=form, wrench=wrench)


def _turned(name: str, values: dict[str, float], form: str, acceleration: Law) -> Hidden:
    """Return an effect that is an angular acceleration [rad/s2]."""

    def wrench(now: Moment) -> Wrench:
        return _NONE, now.inertia_kg_m2 @ acceleration(now)

    return Hidden(name=name, values=values, form=form, wrench=wrench)


@hidden_effect("side_step", "unknown", 0.6, 2.0)
def side_step(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A horizontal force m f that begins at a fixed time, f [m/s2]."""
    begin, along = rng.uniform(0.15, 0.3), horizontal(rng)
    return _pushed(
        "side_step",
        {"f": size, "begin_s": begin},
        "force m f along n after a time",
        lambda now: size * along if now.time_s > begin else _NONE,
    )


@hidden_effect("fading", "unknown", 1.0, 3.0)
def fading(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A force m f exp(-t / tau) along any direction, f [m/s2]."""
    along, tau = direction(rng), rng.uniform(0.08, 0.2)
    return _pushed(
        "fading",
        {"f": size, "tau_s": tau},
        "force m f exp(-t / tau)",
        lambda now: size * np.exp(-max(now.time_s, 0.0) / tau) * along,
    )


@hidden_effect("height_force", "unknown", 0.6, 2.0)
def height_force(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A vertical force of either sign that grows with the height z, m f z / 0.3 m, f [m/s2]."""
    f = sign(rng) * size
    return _pushed("height_force", {"f": f}, "force m f z / 0.3 m upwards", lambda now: f * now.com_m[2] / 0.3 * _UP)


@hidden_effect("swirl", "unknown", 1.0, 4.0)
def swirl(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A horizontal force around a vertical line 0.2 to 0.4 m from the origin, f [1/s2]."""
    line = rng.uniform(0.2, 0.4) * horizontal(rng)
    return _pushed("swirl", {"f": size}, "force m f z x (x - line)", lambda now: size * np.cross(_UP, now.com_m - line))


@hidden_effect("cubic_drag", "unknown", 0.03, 0.1)
def cubic_drag(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A drag -m k v^2 v, k [s/m2]."""
    return _pushed(
        "cubic_drag",
        {"k": size},
        "force -m k v^2 v",
        lambda now: -size * (now.velocity_m_s @ now.velocity_m_s) * now.velocity_m_s,
    )


@hidden_effect("dry_drag", "unknown", 0.3, 1.0)
def dry_drag(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A drag of one size f [m/s2] at all speeds, less below 0.05 m/s."""
    return _pushed(
        "dry_drag",
        {"f": size},
        "force -m f v / |v|",
        lambda now: -size * now.velocity_m_s / max(float(np.linalg.norm(now.velocity_m_s)), 0.05),
    )


@hidden_effect("updraft", "unknown", 0.3, 1.0)
def updraft(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A force upwards that grows with the square of the level speed, f [1/m]."""
    return _pushed(
        "updraft",
        {"f": size},
        "force m f (v_x^2 + v_y^2) upwards",
        lambda now: size * float(now.velocity_m_s[:2] @ now.velocity_m_s[:2]) * _UP,
    )


@hidden_effect("quadratic_lift", "unknown", 0.001, 0.004)
def quadratic_lift(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A lift by the square of the spin, m s |omega| omega x v, s [s]."""
    return _pushed(
        "quadratic_lift",
        {"s": size},
        "force m s |omega| omega x v",
        lambda now: size * np.linalg.norm(now.omega_rad_s) * np.cross(now.omega_rad_s, now.velocity_m_s),
    )


@hidden_effect("late_spin_damping", "unknown", 0.5, 2.0)
def late_spin_damping(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A spin damping that begins at a fixed time, d [1/s]."""
    begin = rng.uniform(0.15, 0.3)
    return _turned(
        "late_spin_damping",
        {"d": size, "begin_s": begin},
        "torque -d I omega after a time",
        lambda now: -size * now.omega_rad_s if now.time_s > begin else _NONE,
    )


@hidden_effect("dry_spin_drag", "unknown", 1.0, 4.0)
def dry_spin_drag(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A torque against the spin of one size at all spins, c [rad/s2], less below 0.3 rad/s."""
    return _turned(
        "dry_spin_drag",
        {"c": size},
        "torque -c I omega / |omega|",
        lambda now: -size * now.omega_rad_s / max(float(np.linalg.norm(now.omega_rad_s)), 0.3),
    )


@hidden_effect("jet", "unknown", 1.0, 3.0)
def jet(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A horizontal push f [m/s2] on one side of a vertical plane near the origin."""
    along, across, edge = horizontal(rng), horizontal(rng), rng.uniform(-0.1, 0.1)
    return _pushed(
        "jet",
        {"f": size, "edge_m": edge},
        "force m f along n where x across > edge",
        lambda now: size * along if now.com_m @ across > edge else _NONE,
    )


@hidden_effect("low_updraft", "unknown", 1.0, 3.0)
def low_updraft(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A vertical force of either sign below a height, f [m/s2]."""
    f, edge = sign(rng) * size, rng.uniform(0.2, 0.4)
    return _pushed(
        "low_updraft",
        {"f": f, "edge_m": edge},
        "force m f upwards below a height",
        lambda now: f * _UP if now.com_m[2] < edge else _NONE,
    )


@hidden_effect("ramp", "unknown", 2.0, 6.0)
def ramp(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A force that grows with time, m f t, along any direction, f [m/s3]."""
    along = direction(rng)
    return _pushed("ramp", {"f": size}, "force m f t along n", lambda now: size * max(now.time_s, 0.0) * along)


@hidden_effect("drag_crisis", "unknown", 0.2, 0.8)
def drag_crisis(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A drag -m c v that acts above a speed of 1.2 to 2 m/s alone, c [1/s]."""
    least = rng.uniform(1.2, 2.0)
    return _pushed(
        "drag_crisis",
        {"c": size, "least_m_s": least},
        "force -m c v above a speed",
        lambda now: -size * now.velocity_m_s if np.linalg.norm(now.velocity_m_s) > least else _NONE,
    )


@hidden_effect("yaw_brake", "unknown", 0.2, 1.0)
def yaw_brake(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A torque against the spin about the vertical alone, d [1/s]."""
    return _turned(
        "yaw_brake", {"d": size}, "torque -d I omega_z about z", lambda now: -size * (now.omega_rad_s @ _UP) * _UP
    )


@hidden_effect("swinging_torque", "unknown", 10.0, 30.0)
def swinging_torque(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A torque about one axis of the world that oscillates at 3 to 5 Hz, amplitude [rad/s2]."""
    axis, frequency, phase = direction(rng), rng.uniform(3, 5), rng.uniform(0, 2 * np.pi)
    return _turned(
        "swinging_torque",
        {"f": size, "frequency_hz": frequency, "phase_rad": phase},
        "torque I f sin(2 pi frequency t + phase)",
        lambda now: size * np.sin(2 * np.pi * frequency * now.time_s + phase) * axis,
    )


DEVELOPMENT = ("side_step", "late_spin_damping", "height_force", "cubic_drag", "dry_drag", "quadratic_lift", "swirl")
DEVELOPMENT += ("fading", "updraft", "dry_spin_drag")
"""Laws that development captures have."""
UNSEEN = ("jet", "low_updraft", "ramp", "drag_crisis", "yaw_brake", "swinging_torque")
"""Laws that reports have from report9 on, and no development capture."""
