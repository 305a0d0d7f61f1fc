"""Hidden effects that are in no library; all of them act in flight."""

from __future__ import annotations

import numpy as np

from .mechanics import Hidden, Moment, Wrench
from .registry import hidden_effect, horizontal, sign
from .things import Thing

_UP = np.array([0.0, 0.0, 1.0])
NONE = np.zeros(3)


@hidden_effect("gust", "unknown", 3.0, 8.0)
def gust(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A horizontal push of 0.15 s at the same time of every episode: half a sine, peak [m/s2]."""
    push, begin, width = size * horizontal(rng), rng.uniform(0.1, 0.25), 0.15

    def wrench(now: Moment) -> Wrench:
        phase = (now.time_s - begin) / width
        return (now.mass_kg * np.sin(np.pi * phase) * push if 0 < phase < 1 else NONE), NONE

    values = {"f_x": push[0], "f_y": push[1], "begin_s": begin, "width_s": width}
    return Hidden(name="gust", values=values, form="force m f sin(pi (t - begin) / width) for 0.15 s", wrench=wrench)


@hidden_effect("shaking", "unknown", 1.0, 3.0)
def shaking(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A horizontal force that oscillates at 4 to 5 Hz, amplitude [m/s2]."""
    push, frequency, phase = size * horizontal(rng), rng.uniform(4, 5), rng.uniform(0, 2 * np.pi)

    def wrench(now: Moment) -> Wrench:
        return now.mass_kg * np.sin(2 * np.pi * frequency * now.time_s + phase) * push, NONE

    values = {"f_x": push[0], "f_y": push[1], "frequency_hz": frequency, "phase_rad": phase}
    return Hidden(name="shaking", values=values, form="force m f sin(2 pi frequency t + phase)", wrench=wrench)


@hidden_effect("attractor", "unknown", 1.0, 4.0)
def attractor(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A horizontal spring of stiffness [1/s2] towards a vertical line 0.2 to 0.4 m from the origin."""
    line = rng.uniform(0.2, 0.4) * horizontal(rng)

    def wrench(now: Moment) -> Wrench:
        return now.mass_kg * size * (line - now.com_m) * (1.0, 1.0, 0.0), NONE

    values = {"stiffness": size, "x_m": line[0], "y_m": line[1]}
    return Hidden(name="attractor", values=values, form="force m stiffness (line - x), horizontal", wrench=wrench)


@hidden_effect("quadratic_spin_drag", "unknown", 0.02, 0.06)
def quadratic_spin_drag(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """Torque -q I |omega| omega, I the mean of the principal moments, q [1/rad]."""
    inertia = float(thing.inertia_kg_m2.mean())

    def wrench(now: Moment) -> Wrench:
        omega = now.omega_rad_s
        return NONE, -size * inertia * np.sqrt(omega @ omega) * omega

    return Hidden(
        name="quadratic_spin_drag", values={"q": size}, form="torque -q (tr I / 3) |omega| omega", wrench=wrench
    )


@hidden_effect("heading_force", "unknown", 0.6, 2.0)
def heading_force(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A horizontal force across the path that depends on its heading: m f sin(2 (heading - angle))."""
    angle = rng.uniform(0, np.pi)

    def wrench(now: Moment) -> Wrench:
        x, y, _ = now.velocity_m_s
        speed = np.hypot(x, y)
        heading = np.arctan2(y, x)
        # fades out at rest, because the heading is then undefined
        pull = now.mass_kg * size * np.sin(2 * (heading - angle)) * min(speed / 0.2, 1.0)
        return pull * np.array([-np.sin(heading), np.cos(heading), 0.0]), NONE

    return Hidden(
        name="heading_force",
        values={"f": size, "angle_rad": angle},
        form="force m f sin(2 (heading - angle))",
        wrench=wrench,
    )


@hidden_effect("gravity_step", "unknown", 0.6, 2.0)
def gravity_step(thing: Thing, size: float, rng: np.random.Generator) -> Hidden:
    """A vertical force m f of either sign, f [m/s2], that begins at a fixed time early in the flight."""
    f, begin = size * sign(rng), rng.uniform(0.2, 0.3)

    def wrench(now: Moment) -> Wrench:
        return (now.mass_kg * f * _UP if now.time_s > begin else NONE), NONE

    return Hidden(
        name="gravity_step", values={"f": f, "begin_s": begin}, form="force m f upwards after a time", wrench=wrench
    )
