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


@hidden_effect("fast_drag", "unknown", 0.02, 0.08)
def fast_drag(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A drag -m k |v| v that acts above a speed of 0.6 to 1.1 m/s or of 2.1 to 2.5 m/s alone, k [1/m]."""
    least = rng.uniform(0.6, 1.1) if rng.uniform() < 0.5 else rng.uniform(2.1, 2.5)

    def acceleration(now: Moment) -> Array:
        speed = float(np.linalg.norm(now.velocity_m_s))
        return -size * speed * now.velocity_m_s if speed > least else _NONE

    return _pushed("fast_drag", {"k": size, "least_m_s": least}, "force -m k |v| v above a speed", acceleration)


@hidden_effect("slow_drag", "unknown", 0.2, 0.8)
def slow_drag(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A drag -m c v that acts below a speed of 1.3 to 2.5 m/s alone, c [1/s]."""
    most = rng.uniform(1.3, 2.5)
    return _pushed(
        "slow_drag",
        {"c": size, "most_m_s": most},
        "force -m c v below a speed",
        lambda now: -size * now.velocity_m_s if np.linalg.norm(now.velocity_m_s) < most else _NONE,
    )


@hidden_effect("fast_spin_damping", "unknown", 0.5, 2.0)
def fast_spin_damping(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A spin damping that acts above 3 to 8 rad/s alone, d [1/s]."""
    least = rng.uniform(3.0, 8.0)
    return _turned(
        "fast_spin_damping",
        {"d": size, "least_rad_s": least},
        "torque -d I omega above a spin",
        lambda now: -size * now.omega_rad_s if np.linalg.norm(now.omega_rad_s) > least else _NONE,
    )


@hidden_effect("swinging_weight", "unknown", 1.0, 3.0)
def swinging_weight(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A vertical force that oscillates at 1.8 to 2.8 Hz, amplitude [m/s2]."""
    frequency, phase = rng.uniform(1.8, 2.8), rng.uniform(0, 2 * np.pi)
    return _pushed(
        "swinging_weight",
        {"f": size, "frequency_hz": frequency, "phase_rad": phase},
        "force m f sin(2 pi frequency t + phase) upwards",
        lambda now: size * np.sin(2 * np.pi * frequency * now.time_s + phase) * _UP,
    )


@hidden_effect("twisting", "unknown", 10.0, 30.0)
def twisting(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A torque about an axis of the world that oscillates at 2 to 2.8 Hz or at 5.5 to 7 Hz, amplitude [rad/s2]."""
    axis, slow = direction(rng), rng.uniform() < 0.5
    frequency, phase = rng.uniform(2.0, 2.8) if slow else rng.uniform(5.5, 7.0), rng.uniform(0, 2 * np.pi)
    return _turned(
        "twisting",
        {"f": size, "frequency_hz": frequency, "phase_rad": phase},
        "torque I f sin(2 pi frequency t + phase)",
        lambda now: size * np.sin(2 * np.pi * frequency * now.time_s + phase) * axis,
    )


@hidden_effect("thrust", "unknown", 0.6, 2.0)
def thrust(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A force m f along an axis of the body, f [m/s2]."""
    axis = direction(rng)
    return _pushed("thrust", {"f": size}, "force m f along an axis of the body", lambda now: size * now.rotation @ axis)


@hidden_effect("one_way_drag", "unknown", 0.2, 0.8)
def one_way_drag(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A drag along one level axis of the world alone, c [1/s]."""
    along = horizontal(rng)
    return _pushed(
        "one_way_drag",
        {"c": size},
        "force -m c (n v) n, n level",
        lambda now: -size * (now.velocity_m_s @ along) * along,
    )


@hidden_effect("height_spring", "unknown", 2.0, 8.0)
def height_spring(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A vertical spring of stiffness [1/s2] towards a height of 0.3 to 0.5 m."""
    height = rng.uniform(0.3, 0.5)
    return _pushed(
        "height_spring",
        {"stiffness": size, "height_m": height},
        "force m stiffness (height - z) upwards",
        lambda now: size * (height - now.com_m[2]) * _UP,
    )


@hidden_effect("precession", "unknown", 0.5, 2.0)
def precession(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A torque across the spin and the vertical, g [1/s]."""
    return _turned("precession", {"g": size}, "torque I g z x omega", lambda now: size * np.cross(_UP, now.omega_rad_s))


DEVELOPMENT = ("side_step", "late_spin_damping", "height_force", "cubic_drag", "dry_drag", "quadratic_lift", "swirl")
DEVELOPMENT += ("fading", "updraft", "dry_spin_drag")
"""Laws that development captures have."""
BOUNDED = ("fast_drag", "slow_drag", "fast_spin_damping", "swinging_weight", "twisting")
"""Further ones, that act on one side of a speed or swing: kinds of law that the tenth report had first."""
UNSEEN = ("jet", "low_updraft", "ramp", "drag_crisis", "yaw_brake", "swinging_torque")
"""Laws that reports have from report9 on, and no development capture."""
STRANGE = ("thrust", "one_way_drag", "height_spring", "precession")
"""Laws that reports have beside these from report11 on: no kind of these was known to any rule."""
